"""Views: weights of colours and known depths of single pixels reach the batches, and shrink with the images."""

from __future__ import annotations

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Views, draw_batch


def cameras(*sizes: tuple[int, int]) -> Cameras:
    count = len(sizes)
    poses = torch.eye(4, dtype=torch.float64).expand(count, 4, 4)
    return Cameras(torch.eye(3, dtype=torch.float64).expand(count, 3, 3), poses, torch.tensor(sizes))


def random_views(**maps: list[torch.Tensor | None]) -> Views:
    """A captured view of 6x4 pixels and a generated one of 5x3."""
    generator = torch.Generator().manual_seed(0)
    sizes = ((6, 4), (5, 3))
    images = [torch.randint(0, 256, (h, w, 3), generator=generator, dtype=torch.uint8) for w, h in sizes]
    return Views.from_images(cameras(*sizes), images, torch.tensor([True, False]), **maps)


def test_without_maps_every_pixel_weighs_one_and_no_depth_is_known() -> None:
    views = random_views()
    batch = draw_batch(views, 50, 1, 0.5, torch.Generator().manual_seed(0))
    assert torch.equal(batch.weight, torch.ones(50))
    assert batch.weight is batch.valid
    assert batch.inverse_depth is batch.inverse_depth_weight is None


def test_maps_of_no_view_are_no_maps() -> None:
    none: list[torch.Tensor | None] = [None, None]
    views = random_views(masks=none, weights=none, depths=none, depth_weights=none)
    assert views.valid is views.weight is views.inverse_depth is views.inverse_depth_weight is None


def test_a_weight_reaches_its_pixel_and_zero_is_never_drawn() -> None:
    weight = torch.linspace(0, 1, 15).view(3, 5)
    weight[1] = 0
    views = random_views(weights=[None, weight])
    assert views.counting.tolist() == [24, 15 - 6]
    batch = draw_batch(views, 400, 1, 0.5, torch.Generator().manual_seed(0))
    generated = batch.view == 1
    assert torch.equal(batch.weight[~generated], torch.ones(int((~generated).sum())))
    x, y = batch.xy[generated].unbind(-1)
    assert torch.equal(batch.weight[generated], weight[y, x])
    assert bool((batch.weight > 0).all())
    part = batch.part(slice(3, 9))
    assert torch.equal(part.weight, batch.weight[3:9])
    assert part.patch == 1


def test_depths_are_known_inversely_and_unknown_ones_have_no_weight() -> None:
    depth = torch.tensor([[1.0, 2.0, 0.0, torch.inf, torch.nan]]).expand(3, 5)
    weight = torch.full((3, 5), 0.5)
    views = random_views(depths=[None, depth], depth_weights=[None, weight])
    assert views.inverse_depth is not None
    assert views.inverse_depth_weight is not None
    assert views.map(views.inverse_depth, 1)[0].tolist() == [1.0, 0.5, 0.0, 0.0, 0.0]
    assert views.map(views.inverse_depth_weight, 1)[0].tolist() == [0.5, 0.5, 0.0, 0.5, 0.0]
    assert not views.map(views.inverse_depth_weight, 0).any(), "no depth was given for the first view"
    plain = random_views(depths=[None, depth])
    assert plain.map(plain.inverse_depth_weight, 1)[0].tolist() == [1.0, 1.0, 0.0, 1.0, 0.0]


def test_halving_means_over_what_is_known() -> None:
    depth = torch.zeros(4, 6)
    depth[0, 0], depth[1, 1], depth[:2, 2:4] = 1.0, 4.0, 2.0
    weight = torch.ones(4, 6)
    weight[0, 0] = 0.25
    whole = random_views(weights=[weight, None], depths=[depth, None])
    small = whole.halved()
    assert small.size.tolist() == [[3, 2], [2, 1]]
    assert small.map(small.weight, 0)[0].tolist() == [0.8125, 1.0, 1.0]
    assert small.map(small.inverse_depth, 0)[0].tolist() == [0.625, 0.5, 0.0]
    assert small.map(small.inverse_depth_weight, 0)[0].tolist() == [0.5, 1.0, 0.0]
    pixels = whole.image(0)[:2, :2].float().mean((0, 1)).round().to(torch.uint8)
    assert torch.equal(small.image(0)[0, 0], pixels)


def test_moving_and_masking_keep_all_maps() -> None:
    whole = random_views(weights=[torch.full((4, 6), 0.5), None], depths=[None, torch.ones(3, 5)])
    kept = torch.arange(24 + 15) % 2 == 0
    some = whole.to("cpu").only(kept)
    assert some.counting.tolist() == [12, 8]
    assert torch.equal(some.weight, whole.weight)
    assert torch.equal(some.inverse_depth, whole.inverse_depth)
    assert whole.valid is not None
    assert bool(whole.valid.all()), "the others stay as they are"


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({"weights": [torch.ones(4, 6)]}, "1 weights for 2 images"),
        ({"weights": [torch.ones(3, 6), None]}, "weight of view 0 has shape"),
        ({"weights": [None, torch.full((3, 5), 1.5)]}, "weight of view 1 has values outside"),
        ({"depth_weights": [None, torch.full((3, 5), torch.nan)]}, "depth weight of view 1 has values outside"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(maps: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        random_views(**maps)


def test_the_pixels_that_count_are_found_by_their_number() -> None:
    """Against the list of all of them, with views of odd sizes, empty ones, and blocks of which no pixel counts."""
    sizes = [(7, 5), (40, 33), (1, 1), (64, 2), (9, 9)]
    generator = torch.Generator().manual_seed(1)
    masks = [torch.rand((h, w), generator=generator) < share for (w, h), share in zip(sizes, (0.5, 0.03, 1, 0, 1))]
    cameras = Cameras(torch.eye(3).expand(5, 3, 3), torch.eye(4).expand(5, 4, 4), torch.tensor(sizes))
    images = (torch.zeros((h, w, 3), dtype=torch.uint8) for w, h in sizes)
    views = Views.from_images(cameras, images, torch.ones(5, dtype=torch.bool), masks)
    assert views.counting.tolist() == [int(mask.sum()) for mask in masks]
    for view, mask in enumerate(masks):
        rows, columns = mask.nonzero(as_tuple=True)
        number = torch.arange(len(rows))
        xy = views.pixel(torch.full_like(number, view), number)
        assert torch.equal(xy, torch.stack([columns, rows], -1))


@pytest.mark.parametrize("size", [(6, 1), (1, 6)])
def test_views_one_pixel_wide_or_high_cannot_be_halved(size: tuple[int, int]) -> None:
    image = torch.zeros(size[1], size[0], 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match="View 0 is too small to be halved"):
        Views.from_images(cameras(size), [image], torch.tensor([True])).halved()
