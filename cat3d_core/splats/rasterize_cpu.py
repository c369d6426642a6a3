"""The rasteriser as C++ kernels (splats.cpp)."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.cpu_library import library, pointer
from cat3d_core.splats.reference import (
    BLUR,
    LEAST_ALPHA,
    LEAST_LIGHT,
    LEAST_RATIO,
    MOST_ALPHA,
    NEAR,
    STEEPEST,
    Raster,
    Window,
    whole,
)  # fmt: skip

SOURCE = "splats/splats"
TILE = 8  # as in the kernels
IMAGE, SHAPE = 9, 7  # numbers of an image, and of its gradient without the features'
CHANNELS = (1, 3, 4, 6)


def available() -> bool:
    """Whether the kernels are there; compiles them at the first call and warns once where that fails."""
    return library(SOURCE) is not None


def _kernel(name: str, dtype: torch.dtype) -> Any:
    kernels = library(SOURCE)
    assert kernels is not None
    return getattr(kernels, f"splats_{'single' if dtype == torch.float32 else 'double'}_{name}")


def _camera(camera: Cameras, antialias: bool, dtype: torch.dtype) -> Tensor:
    """The kernels' struct Camera as one tensor."""
    camera = camera.to(dtype=torch.float64)
    pose, k = camera.camera_from_world[0], camera.intrinsics[0]
    lens = torch.stack([k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]])
    ratio = LEAST_RATIO if antialias else -1.0
    rest = torch.tensor([STEEPEST, NEAR, BLUR, ratio, LEAST_ALPHA, MOST_ALPHA, LEAST_LIGHT], dtype=torch.float64)
    return torch.cat([pose[:3, :3].reshape(-1), pose[:3, 3], lens, rest]).to(dtype).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, features: Tensor,
        camera: Tensor, window: Window,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        shape = tuple(value.contiguous() for value in (means, quaternions, scales, opacities))
        features = features.contiguous()
        count, channels, threads = len(means), features.shape[1], ctypes.c_int(torch.get_num_threads())
        area = (ctypes.c_int32 * 4)(*window)
        images, tiles = means.new_empty((count, IMAGE)), torch.empty((count, 4), dtype=torch.int32)
        order, counts = torch.empty(count, dtype=torch.int32), torch.zeros(2, dtype=torch.int64)
        _kernel("project", means.dtype)(
            *map(pointer, shape), ctypes.c_int64(count), pointer(camera), area,
            pointer(images), pointer(tiles), pointer(order), pointer(counts), threads,
        )  # fmt: skip
        shown, entries = counts.tolist()
        number = -(-window.width // TILE) * -(-window.height // TILE)
        begins = torch.empty(number + 1, dtype=torch.int64)
        gaussian, place = torch.empty(entries, dtype=torch.int32), torch.empty(entries, dtype=torch.int64)
        out = means.new_empty((channels + 1, window.height, window.width))
        light, median = torch.empty_like(out[0]), torch.empty_like(out[0])
        last = torch.empty(light.shape, dtype=torch.int32)
        if _kernel("forward", means.dtype)(
            pointer(images), pointer(tiles), pointer(order), ctypes.c_int64(shown), pointer(features),
            ctypes.c_int(channels), pointer(camera), area, pointer(begins), pointer(gaussian), pointer(place),
            pointer(out), pointer(light), pointer(last), pointer(median), threads,
        ):  # fmt: skip
            raise ValueError(f"The CPU rasteriser has {CHANNELS} features, not {channels}.")
        ctx.save_for_backward(*shape, features, camera, images, tiles, order, begins, gaussian, place, light, last)
        ctx.window, ctx.shown = window, shown
        ctx.mark_non_differentiable(median)
        return out, light, median

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, light_gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *shape, features, camera, images, tiles, order, begins, gaussian, place, light, last = ctx.saved_tensors
        out = [torch.zeros_like(value) for value in (*shape, features)]
        channels = features.shape[1]
        scratch = features.new_empty((len(gaussian), SHAPE + channels))
        gradient, light_gradient = gradient.contiguous(), light_gradient.contiguous()
        _kernel("backward", features.dtype)(
            *map(pointer, shape), ctypes.c_int64(len(features)), pointer(images), pointer(tiles), pointer(order),
            ctypes.c_int64(ctx.shown), pointer(features), ctypes.c_int(channels), pointer(camera),
            (ctypes.c_int32 * 4)(*ctx.window), pointer(begins), pointer(gaussian), pointer(place), pointer(light),
            pointer(last), pointer(gradient), pointer(light_gradient), pointer(scratch), *map(pointer, out),
            ctypes.c_int(torch.get_num_threads()),
        )  # fmt: skip
        return (*out, None, None)


def rasterize(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, features: Tensor,
    camera: Cameras, window: Window | None = None, antialias: bool = True,
) -> Raster:  # fmt: skip
    """As `reference.rasterize` for float32 or float64 tensors on the CPU with 1, 3, 4 or 6 features; deterministic, the
    same with any number of threads.

    Raises ValueError for shapes and dtypes that do not fit (the kernels check nothing).
    """
    tensors = (means, quaternions, scales, opacities, features)
    count = len(means)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, features.shape[-1]))
    if any(value.shape != shape for value, shape in zip(tensors, shapes, strict=True)):
        found = [tuple(value.shape) for value in tensors]
        raise ValueError(
            f"Expected means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), features; {found}."
        )
    if means.dtype not in (torch.float32, torch.float64) or any(
        value.dtype != means.dtype or value.device.type != "cpu" for value in tensors
    ):
        raise ValueError("The CPU rasteriser takes float32 or float64 tensors, all of one dtype, on the CPU.")
    window = window or whole(camera)
    if window.width < 1 or window.height < 1:
        raise ValueError(f"A window of {window.width} x {window.height} pixels is empty.")
    out, light, median = _Rasterize.apply(*tensors, _camera(camera, antialias, means.dtype), window)
    return Raster(out[:-1], out[-1], 1.0 - light, median)
