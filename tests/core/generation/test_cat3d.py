"""Our own model behind the protocol: what it says of itself, padding, batches, memory, pictures in and out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest
import torch

from cat3d_core.diffusion import GuidanceConfig, SamplerConfig, sample
from cat3d_core.generation import Cat3dGenerator, MemoryTooSmall, ViewGroup, cat3d_spec, generate
from cat3d_core.generation import cat3d as module
from cat3d_core.generation.advice import MEASURED, PAPER
from cat3d_core.random import normal
from cat3d_core.rays import reference_from_image
from tests.core.diffusion.models import random_model, tiny
from tests.core.plan.layouts import ring

SHAPE = (8, 8, 8)
FAST = SamplerConfig(steps=3)


@pytest.fixture(scope="module")
def generator() -> Cat3dGenerator:
    return Cat3dGenerator(random_model(relative_cameras=True))


def group(number: int, given: int = 3, targets: int = 5) -> ViewGroup:
    cameras = ring(12)[[(number + i) % 12 for i in range(given + targets)]]
    latents = torch.stack([normal(SHAPE, 0, "given", number, i) for i in range(given)])
    return ViewGroup(latents, cameras, torch.stack([normal(SHAPE, 0, "noise", number, i) for i in range(targets)]))


def test_the_spec_is_that_of_the_configuration() -> None:
    spec = cat3d_spec(tiny(), "a", "b", {"steps": 4, "solver": "ddim", "guidance": 1.0})
    assert (spec.views, spec.given, spec.image_size, spec.latent_shape) == (8, (1, 2, 3, 4, 5, 6, 7), (64, 64), SHAPE)
    assert (spec.identity, spec.encoder_identity) == ("a", "b")
    assert spec.advice == dataclasses.replace(
        MEASURED, solver="ddim", steps=4, guidance=dataclasses.replace(MEASURED.guidance, scale=1.0)
    )
    assert spec.reference == dataclasses.replace(PAPER, guidance=GuidanceConfig(1.0)), "guidance stays the model's"
    assert cat3d_spec(tiny()).advice == MEASURED
    assert cat3d_spec(tiny()).wants == frozenset()
    told = dataclasses.replace(tiny(), unet=dataclasses.replace(tiny().unet, hints=True))
    assert cat3d_spec(told).wants == frozenset({"hints"})


def test_cost_counts_guidance_twice_and_short_groups_as_full_ones() -> None:
    cost = cat3d_spec(tiny()).cost
    plain = cost(3, 5, SamplerConfig("ddim", "trailing", 50, GuidanceConfig(1.0)))
    assert plain.evaluations == 50
    assert cost(3, 5, SamplerConfig("ddim", "trailing", 50)).evaluations == 100
    assert cost(3, 1, SamplerConfig("ddim", "trailing", 50, GuidanceConfig(1.0))) == plain
    assert plain.flops == 50 * module._flops(tiny().unet, 8)


def test_groups_of_any_shape_come_back_in_order_and_are_the_plain_sampler_bit_for_bit(
    generator: Cat3dGenerator,
) -> None:
    groups = [group(0), group(1, 1, 7), group(2, 3, 2), group(3, 3, 5)]
    made = list(generator.sample(iter(groups), FAST))
    assert [len(part) for part in made] == [5, 7, 2, 5]
    for one, latents in zip(groups, made, strict=True):
        cameras = reference_from_image(one.cameras, one.cameras.world_from_camera[0])
        alone = sample(generator.model, one.latents[None], cameras[None], one.noise[None], FAST)[0]
        assert torch.equal(latents, alone)
    together = list(generator.sample(groups, dataclasses.replace(FAST, micro_batch=4)))
    for one, other in zip(made, together, strict=True):
        torch.testing.assert_close(other, one, rtol=0, atol=1e-4)


def test_each_group_is_there_before_the_next_is_asked_for(generator: Cat3dGenerator) -> None:
    asked = []

    def groups() -> Iterator[ViewGroup]:
        for number in range(3):
            asked.append(number)
            yield group(number)

    made = generator.sample(groups(), FAST)
    next(made)
    assert len(asked) < 3, "a worker stores the first group before it reads what the last one needs"


def test_out_of_memory_halves_the_batch_remembers_it_and_gives_the_same(
    generator: Cat3dGenerator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The allocator's error is raised by hand where more than one group is evaluated; the rest is real."""
    real, tried = module.sample, []
    alone = list(generator.sample([group(n) for n in range(4)], FAST))

    def limited(*arguments):  # type: ignore[no-untyped-def]
        tried.append(arguments[4].micro_batch)
        if arguments[4].micro_batch > largest:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return real(*arguments)

    monkeypatch.setattr(module, "sample", limited)
    short, largest = Cat3dGenerator(generator.model), 1
    four = dataclasses.replace(FAST, micro_batch=4)
    for one, other in zip(alone, short.sample([group(n) for n in range(4)], four), strict=True):
        assert torch.equal(one, other)
    assert tried == [4, 2, 1]
    list(short.sample([group(9)], four))
    assert tried[3:] == [1], "what didn't fit isn't tried again"
    largest = 0
    with pytest.raises(MemoryTooSmall, match="Memory doesn't hold one group of 8 views on cpu"):
        list(Cat3dGenerator(generator.model).sample([group(0)], FAST))


def test_other_errors_are_not_taken_for_a_lack_of_memory(
    generator: Cat3dGenerator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments):  # type: ignore[no-untyped-def]
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    monkeypatch.setattr(module, "sample", broken)
    with pytest.raises(RuntimeError, match="mat1"):
        list(generator.sample([group(0)], FAST))


def test_pictures_in_pictures_out_in_as_many_groups_as_it_takes(generator: Cat3dGenerator) -> None:
    images = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    cameras = ring(12)

    def noise(scene: int, view: int) -> torch.Tensor:
        return normal(SHAPE, scene, view)

    scenes = [(images, cameras[:9]), (images[:1], cameras[:4])]
    first, second = generate(generator, scenes, FAST, noise)
    assert (first.shape, second.shape) == ((6, 3, 64, 64), (3, 3, 64, 64))
    assert first.min() >= 0
    assert first.max() <= 1
    latents = generator.encode(images)
    last = ViewGroup(latents, cameras[[0, 1, 2, 8]], noise(0, 8)[None])
    (alone,) = generator.sample([last], FAST)
    torch.testing.assert_close(first[5:], generator.decode(alone), rtol=0, atol=1e-5)


def test_a_group_without_a_camera_for_each_view_is_refused() -> None:
    one = group(0)
    with pytest.raises(ValueError, match="3 given views, 5 target views and 7 cameras"):
        ViewGroup(one.latents, one.cameras[:7], one.noise)
    with pytest.raises(ValueError, match="0 given views"):
        ViewGroup(one.latents[:0], one.cameras[:5], one.noise)
