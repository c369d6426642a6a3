"""The shipped model: present, whole, small enough, and better than noise on a held-out scene."""

import pytest
import torch

from cat3d_core.diffusion import describe, load_model
from cat3d_core.generation import Cat3dGenerator, generate
from cat3d_core.generation.advice import FEW_STEPS
from cat3d_core.metrics.psnr import psnr
from cat3d_core.random import normal
from cat3d_core.synthetic.dataset import training_capture
from cat3d_core.weights import default_model_path


def test_it_says_what_it_is_and_fits_the_budget():
    path = default_model_path()
    told = describe(path)
    assert len(told["sha256"]) == 64
    assert {"data", "steps", "groups_of_views"} <= set(told["provenance"])
    assert sum(f.stat().st_size for f in path.parent.glob("*.safetensors")) <= 48_000_000


@pytest.mark.slow
def test_its_samples_follow_the_views_given():
    """Against the flat mean colour of the views given, which is what a model that ignores cameras could reach."""
    generator = Cat3dGenerator(load_model(default_model_path()))
    size, shape = generator.spec.image_size[0], generator.spec.latent_shape
    gains = []
    for number, family in enumerate(("llff", "dtu", "re10k")):
        capture = training_capture(family, 10_000_019 + number, 8, size)
        noise = normal((5, *shape), 0, family)
        given = [(capture.image[:3], capture.cameras)]
        (images,) = generate(generator, given, FEW_STEPS, lambda _, view: noise[view - 3])  # noqa: B023
        truth = capture.image[3:]
        flat = capture.image[:3].mean((0, 2, 3))[None, :, None, None].expand_as(truth)
        gains.append(psnr(images, truth).mean() - psnr(flat, truth).mean())
    assert float(torch.stack(gains).mean()) > 1.0
