"""The shipped model: present, whole, small enough, and better than noise on a held-out scene."""

import torch

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, describe, load_model, sample
from cat3d_core.metrics.psnr import psnr
from cat3d_core.random import normal
from cat3d_core.rays import raymap
from cat3d_core.synthetic.dataset import training_capture
from cat3d_core.weights import default_model_path


def test_it_says_what_it_is_and_fits_the_budget():
    path = default_model_path()
    told = describe(path)
    assert len(told["sha256"]) == 64
    assert {"data", "steps", "groups_of_views"} <= set(told["provenance"])
    assert sum(f.stat().st_size for f in path.parent.glob("*.safetensors")) <= 48_000_000


def test_its_samples_follow_the_views_given():
    """Against the flat mean colour of the views given, which is what a model that ignores cameras could reach."""
    model = load_model(default_model_path())
    sampler = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(scale=1.0))
    gains = []
    for number, family in enumerate(("llff", "dtu", "re10k")):
        capture = training_capture(family, 10_000_019 + number, 8, model.config.image_size)
        cameras = capture.cameras
        latents = model.autoencoder.encode(capture.image)
        rays = raymap(cameras, cameras.world_from_camera[0], *latents.shape[-2:]).float()
        noise = normal((1, 5, *latents.shape[1:]), 0, family)
        images = model.autoencoder.decode(sample(model, latents[None, :3], rays[None], noise, sampler)[0])
        truth = capture.image[3:]
        flat = capture.image[:3].mean((0, 2, 3))[None, :, None, None].expand_as(truth)
        gains.append(psnr(images, truth).mean() - psnr(flat, truth).mean())
    assert float(torch.stack(gains).mean()) > 1.0
