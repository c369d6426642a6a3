"""SEVA's weights used for other windows and images than they were trained on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cat3d_core.generation import ViewGroup
from cat3d_core.seva.checkpoint import random_seva, save_seva
from cat3d_core.seva.config import TINY
from cat3d_core.seva.generator import REFERENCE, SevaGenerator, seva_spec
from cat3d_core.seva.model import SevaModel, load_seva_model
from tests.core.seva.models import ring, write_parts


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> SevaModel:
    folder = tmp_path_factory.mktemp("seva")
    vae, tower, _ = write_parts(folder)
    save_seva(folder / "model.safetensors", random_seva(TINY, seed=1))
    return load_seva_model(folder / "model.safetensors", vae, tower)


def _group(generator: SevaGenerator, side: int) -> ViewGroup:
    """One given view and two targets of a ring of cameras."""
    g = torch.Generator().manual_seed(0)
    images = torch.rand(1, 3, side, side, generator=g)
    noise = torch.randn(2, 4, side // 8, side // 8, generator=g)
    return ViewGroup(generator.encode(images), ring(3, side, side), noise, images=images)


def test_the_spec_of_other_windows_and_images() -> None:
    spec = seva_spec(TINY, "weights", "encoder")
    assert spec.at is not None
    other = spec.at(8, 128)
    assert (other.views, other.image_size, other.latent_shape) == (8, (128, 128), (4, 16, 16))
    assert (other.identity, other.encoder_identity) == ("weights", "encoder")
    assert spec.at(None, None) == spec
    assert other.cost(3, 5, REFERENCE).flops > 2 * spec.cost(2, 3, REFERENCE).flops
    with pytest.raises(ValueError, match="100 pixels a side are not multiples of 64"):
        spec.at(None, 100)


@torch.no_grad()
def test_samples_are_of_the_specs_size_and_windows(model: SevaModel) -> None:
    """Short windows are filled up to the spec's length, which changes what is sampled."""
    generator, sampler = SevaGenerator(model), replace(REFERENCE, steps=2, micro_batch=1)
    assert generator.spec.at is not None
    own = next(iter(generator.sample([_group(generator, 64)], sampler)))
    assert own.shape == (2, 4, 8, 8)
    assert torch.equal(next(iter(generator.sample([_group(generator, 64)], sampler))), own)
    generator.spec = generator.spec.at(7, None)
    assert not torch.equal(next(iter(generator.sample([_group(generator, 64)], sampler))), own)
    generator.spec = generator.spec.at(5, 128)
    wide = next(iter(generator.sample([_group(generator, 128)], sampler)))
    assert wide.shape == (2, 4, 16, 16)
    assert bool(torch.isfinite(wide).all())


@pytest.mark.parametrize("side", [0, -64, 100])
def test_images_of_no_size_or_an_odd_one_are_refused(side: int) -> None:
    with pytest.raises(ValueError, match="multiple"):
        replace(TINY, image_size=side)
