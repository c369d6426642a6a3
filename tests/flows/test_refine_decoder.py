"""Refining a decoder: it learns, the latents keep their meaning, and the model it came from stays as it is."""

from __future__ import annotations

import copy

import torch

from cat3d_core.diffusion import SIZES, Autoencoder
from flows.training.autoencoder import refine_decoder


def test_only_a_copy_of_the_decoder_changes() -> None:
    torch.manual_seed(0)
    before = Autoencoder(SIZES["tiny"].autoencoder).eval().requires_grad_(False)
    state = copy.deepcopy(before.state_dict())
    renders = (torch.rand(16, 3, 1, 1) * 255).expand(-1, -1, 16, 16).to(torch.uint8).contiguous()
    seen: list[float] = []

    def distance(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:  # stands in for downloaded weights
        return (one - other).square().mean((1, 2, 3))

    after = refine_decoder(
        before, renders, None, 3.0, distance, batch=8, learning_rate=3e-3, report=lambda passed, l1, d: seen.append(l1)
    )  # type: ignore[arg-type]
    images = renders.float() / 255
    assert all(torch.equal(state[name], value) for name, value in before.state_dict().items())
    assert torch.equal(after.encode(images), before.encode(images))
    assert not torch.equal(after.decode(before.encode(images)), before.decode(before.encode(images)))
    assert sum(seen[-3:]) < 0.8 * sum(seen[:3])
    assert not any(p.requires_grad for p in after.parameters())
