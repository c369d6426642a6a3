"""Camera models of other programs as K and the coefficients of `media.lens.distort`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from flows.errors import InputError
from flows.readers.parsing import pinhole

# COLMAP's model -> number of focal lengths, and the coefficient that each later parameter is (after cx, cy).
COEFFICIENTS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": (1, ()),
    "FISHEYE": (2, ()),
    "SIMPLE_RADIAL_FISHEYE": (1, ("k1",)),
    "RADIAL_FISHEYE": (1, ("k1", "k2")),
    "OPENCV_FISHEYE": (2, ("k1", "k2", "k3", "k4")),
    "THIN_PRISM_FISHEYE": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
}
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_ORDER = ("k1", "k2", "k3", "k4")


class Lens(NamedTuple):
    """K (3, 3) in pixels, coefficients (8) as in `media.lens.distort` padded with zeros, and whether it is fisheye."""

    intrinsics: Tensor
    distortion: Tensor
    fisheye: bool


def lens_of(model: str, params: Sequence[float], source: Path | str) -> Lens:
    """The lens of a COLMAP camera. Raises InputError for a model that no coefficients express."""
    if model not in COEFFICIENTS:
        raise InputError(
            f"{source}: camera model {model} is not supported ({', '.join(COEFFICIENTS)} are); "
            "undistort the images with COLMAP's image_undistorter first."
        )
    focals, names = COEFFICIENTS[model]
    fx, fy = params[0], params[focals - 1]
    cx, cy = params[focals : focals + 2]
    values = dict(zip(names, params[focals + 2 :], strict=True))
    fisheye = "FISHEYE" in model
    return Lens(pinhole(fx, fy, cx, cy), coefficients(values, fisheye, source, model), fisheye)


def coefficients(values: dict[str, float], fisheye: bool, source: Path | str, model: str) -> Tensor:
    """(8) the named coefficients in order. Raises InputError for one that the model has no place for and is not 0."""
    order = FISHEYE_ORDER if fisheye else ORDER
    unknown = [name for name, value in values.items() if value and name not in order]
    if unknown:
        raise InputError(
            f"{source}: camera model {model} with {', '.join(unknown)} other than 0 is not supported; "
            "undistort the images first."
        )
    numbers = [float(values.get(name, 0.0)) for name in order]
    return torch.tensor(numbers + [0.0] * (len(ORDER) - len(numbers)), dtype=torch.float64)


def stacked(lenses: Sequence[Lens]) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """K (N, 3, 3), distortion (N, 5 or 8) or None where there is none, fisheye (N) bool or None where none is."""
    intrinsics = torch.stack([lens.intrinsics for lens in lenses])
    distortion = torch.stack([lens.distortion for lens in lenses])
    fisheye = torch.tensor([lens.fisheye for lens in lenses])
    if not fisheye.any() and not distortion[:, 5:].any():
        distortion = distortion[:, :5]
    bent = distortion if distortion.any() or fisheye.any() else None
    return intrinsics, bent, fisheye if fisheye.any() else None
