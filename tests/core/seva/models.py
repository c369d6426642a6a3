"""Small networks of SEVA's kind and inputs for them, and the numbers of the original where they are on this machine."""

from __future__ import annotations

import json
import re
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion.foreign_autoencoders import KLAutoencoder
from cat3d_core.diffusion.ldm_names import from_ldm
from cat3d_core.metrics.clip import ClipConfig, ClipImageTower
from cat3d_core.seva.checkpoint import random_seva, save_seva
from cat3d_core.seva.config import TINY, SevaConfig
from cat3d_core.seva.network import SevaUNet

EXPECTED = Path(__file__).with_name("expected.safetensors")


def fixture_network(folder: Path) -> tuple[SevaUNet, dict[str, Tensor]]:
    """The fixture's network of random weights, and the other tensors of its file."""
    tensors = load_file(folder / "seva_tiny.safetensors")
    state = {name.removeprefix("state."): t.float() for name, t in tensors.items() if name.startswith("state.")}
    ours = from_ldm(state)
    network = SevaUNet(TINY).eval().requires_grad_(False)
    network.load_state_dict({ours[name]: t for name, t in state.items()})
    return network, tensors


def normalised_cameras(world_from_camera: Tensor, intrinsics: Tensor, width: int = 192, height: int = 128) -> Cameras:
    """Cameras of images of one size from intrinsics that are divided by it."""
    scale = torch.tensor([width, height, 1.0]).to(intrinsics)
    size = torch.tensor([[width, height]]).expand(len(intrinsics), 2).clone()
    return Cameras(intrinsics * scale[:, None], world_from_camera, size)


def inputs(groups: int, views: int, height: int = 16, width: int = 24, seed: int = 0) -> tuple[Tensor, ...]:
    """x [G*V, 11, h, w], time [G*V], rays [G*V, 6, h, w], context [G*V, 1, 24] of `SevaUNet.folded`."""
    g = torch.Generator().manual_seed(seed)
    count = groups * views
    return (
        torch.randn(count, 11, height, width, generator=g),
        torch.randint(0, 1000, (groups,), generator=g).repeat_interleave(views),
        torch.randn(count, 6, height, width, generator=g),
        torch.randn(count, 1, 24, generator=g),
    )


def ring(count: int, width: int = 96, height: int = 64, seed: int = 0) -> Cameras:
    """Cameras on a circle of radius 3 that look at its middle, float64."""
    g = torch.Generator().manual_seed(seed)
    angle = torch.linspace(0, 2, count, dtype=torch.float64)
    center = torch.stack([3 * angle.cos(), 3 * angle.sin(), 0.5 + 0.2 * torch.rand(count, generator=g).double()], -1)
    forward = -center / center.norm(dim=-1, keepdim=True)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double().expand_as(forward))
    right = right / right.norm(dim=-1, keepdim=True)
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    pose[:, :3, 3] = center
    k = torch.tensor([[80.0, 0, width / 2], [0, 80, height / 2], [0, 0, 1]]).double().repeat(count, 1, 1)
    return Cameras(k, pose, torch.tensor([[width, height]]).expand(count, 2).clone())


def write_parts(
    folder: Path, channels: int = 4, scale: float = 0.18215, dimensions: int = 24
) -> tuple[Path, Path, ClipImageTower]:
    """A tiny random autoencoder in vae/ and image tower in image_encoder/, as diffusers and OpenCLIP name theirs: the
    folder, the file, and the tower itself."""
    vae, encoder = folder / "vae", folder / "image_encoder"
    for part in (vae, encoder):
        part.mkdir(parents=True)
    torch.manual_seed(0)
    config = {"block_out_channels": [16, 16, 16, 16], "layers_per_block": 1, "norm_num_groups": 8}
    config |= {"latent_channels": channels, "scaling_factor": scale, "_class_name": "AutoencoderKL"}
    (vae / "config.json").write_text(json.dumps(config))
    save_file(KLAutoencoder(config).state_dict(), vae / "diffusion_pytorch_model.safetensors")
    tower = ClipImageTower(ClipConfig(64, 2, 128, 8, 32, dimensions, 1, quick_gelu=False))
    parts = {"qkv.": "attn.in_proj_", "out.": "attn.out_proj.", "fc.": "mlp.c_fc.", "proj.": "mlp.c_proj."}
    state = {}
    for name, value in tower.state_dict().items():
        theirs = re.sub(r"^blocks\.(\d+)\.", r"transformer.resblocks.\1.", name)
        for ours, new in parts.items():
            theirs = re.sub(rf"^(transformer\.resblocks\.\d+\.){re.escape(ours)}", rf"\g<1>{new}", theirs)
        state[f"visual.{theirs}"] = value.contiguous()
    save_file(state, encoder / "open_clip_model.safetensors")
    return vae, encoder / "open_clip_model.safetensors", tower


def write_seva(folder: Path, config: SevaConfig = TINY, seed: int = 0) -> Path:
    """All that `--model FOLDER` takes, tiny and random."""
    write_parts(folder, dimensions=config.context_channels)
    save_seva(folder / "modelv1.1.safetensors", random_seva(config, seed))
    return folder
