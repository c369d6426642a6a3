"""Training an autoencoder: it learns, its decoder alone where that is asked for, from the linear start it says."""

from __future__ import annotations

import copy
from dataclasses import replace

import torch

from cat3d_core.diffusion import SIZES, Autoencoder
from flows.training.autoencoder import new_autoencoder, reconstruction_psnr, train_autoencoder

TINY = SIZES["tiny"].autoencoder


def test_with_decoder_only_the_latents_keep_their_meaning() -> None:
    torch.manual_seed(0)
    before = Autoencoder(TINY).eval().requires_grad_(False)
    state = copy.deepcopy(before.state_dict())
    renders = (torch.rand(16, 3, 1, 1) * 255).expand(-1, -1, 16, 16).to(torch.uint8).contiguous()
    seen: list[dict[str, float]] = []

    def distance(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:  # stands in for downloaded weights
        return (one - other).square().mean((1, 2, 3))

    after = train_autoencoder(
        before, renders, None, 6.0, batch=8, learning_rate=1e-2, perceptual=distance, decoder_only=True,
        report=lambda passed, numbers: seen.append(numbers),
    )  # fmt: skip
    images = renders.float() / 255
    assert all(torch.equal(state[name], value) for name, value in before.state_dict().items())
    assert torch.equal(after.encode(images), before.encode(images))
    assert not torch.equal(after.decode(before.encode(images)), before.decode(before.encode(images)))
    assert sum(n["l1"] for n in seen[-3:]) < 0.8 * sum(n["l1"] for n in seen[:3])
    assert seen[0]["perceptual"] > 0
    assert not any(p.requires_grad for p in after.parameters())


def test_with_a_linear_part_training_starts_from_principal_components_and_all_parts_learn() -> None:
    random = torch.Generator().manual_seed(1)
    coarse = torch.rand(64, 3, 3, 3, generator=random)
    renders = torch.nn.functional.interpolate(coarse, (16, 16), mode="bicubic").clamp(0, 1).mul(255).to(torch.uint8)
    start = new_autoencoder(replace(TINY, linear=True), renders, None, 0)
    plain = new_autoencoder(TINY, renders, None, 0)
    images = renders.float() / 255
    assert reconstruction_psnr(start, images) > reconstruction_psnr(plain, images) + 5
    after = train_autoencoder(start, renders, None, 3.0, batch=8)
    assert reconstruction_psnr(after, images) > reconstruction_psnr(start, images)
    for name in ("analysis.weight", "synthesis.weight", "encoder.1.weight", "decoder.0.weight"):
        assert not torch.equal(after.state_dict()[name], start.state_dict()[name]), name
