"""Square crops and padded wide samples: their boxes, intrinsics and kept windows."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cat3d_core.sample_sets import kept_window, sample_cameras, source_boxes
from tests.core.plan.layouts import cameras

F64 = torch.float64
sides = st.integers(8, 300)


def one(width: int, height: int):  # type: ignore[no-untyped-def]
    return cameras(torch.tensor([[0.3, -2.0, 0.5]], dtype=F64), width=width, height=height)


def test_boxes_of_a_landscape_and_a_portrait_image() -> None:
    size = torch.tensor([[300, 200], [200, 301]])
    assert source_boxes(size, "square").tolist() == [[50, 0, 200], [0, 50, 200]]
    assert source_boxes(size, "wide").tolist() == [[0, -50, 300], [-50, 0, 301]]
    with pytest.raises(ValueError, match="no sample kind 'tall'"):
        source_boxes(size, "tall")


@given(sides, sides, st.sampled_from(["square", "wide"]), st.integers(4, 128))
def test_a_world_point_lands_where_the_box_takes_it(width: int, height: int, kind: str, image_size: int) -> None:
    camera = one(width, height)
    points = torch.tensor([[0.0, 0, 0], [0.1, -0.2, 0.1]], dtype=F64)
    x0, y0, side = source_boxes(camera.size, kind)[0].tolist()
    expected = (camera.project(points)[0] - torch.tensor([x0, y0], dtype=F64)) * image_size / side
    sample = sample_cameras(camera, kind, image_size)
    assert torch.allclose(sample.project(points)[0], expected, atol=1e-9)
    assert sample.size.tolist() == [[image_size, image_size]]


@given(sides, sides, st.integers(4, 128))
def test_the_kept_window_holds_only_pixels_of_the_image(width: int, height: int, image_size: int) -> None:
    size = torch.tensor([[width, height]])
    x0, y0, w, h = kept_window(size, "wide", image_size)[0].tolist()
    bx, by, side = source_boxes(size, "wide")[0].tolist()
    scale = image_size / side
    for begin, length, box, full in ((x0, w, bx, width), (y0, h, by, height)):
        assert begin >= -box * scale - 1e-4
        assert begin + length <= (full - box) * scale + 1e-4
        # No whole image pixel is left out on either side.
        assert begin - 1 < -box * scale
        assert begin + length + 1 > (full - box) * scale
    assert kept_window(size, "square", image_size).tolist() == [[0, 0, image_size, image_size]]


def test_square_images_have_one_kind_of_sample() -> None:
    camera = one(64, 64)
    assert torch.equal(sample_cameras(camera, "square", 32).intrinsics, sample_cameras(camera, "wide", 32).intrinsics)
    assert kept_window(camera.size, "wide", 32).tolist() == [[0, 0, 32, 32]]
