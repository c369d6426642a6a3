"""What all pixels of many views have, one view after another: filled a view at a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras

Maps = Sequence[Tensor | None] | None


def pixel_buffer(cameras: Cameras, images: Iterable[Tensor], captured: int) -> Tensor:
    """(P, 3) uint8: the images of all cameras, each taken once. Raises ValueError where one does not fit its camera."""
    ends = cameras.size.prod(-1).cumsum(0).tolist()
    pixels, count = torch.empty(0), 0
    for count, image in enumerate(images, 1):
        if count > len(ends):
            continue
        width, height = cameras.size[count - 1].tolist()
        if image.dtype != torch.uint8 or tuple(image.shape) != (height, width, 3):
            raise ValueError(
                f"The image of view {count - 1} is {image.dtype} {tuple(image.shape)}; its camera needs uint8 "
                f"{(height, width, 3)}."
            )
        if count == 1:
            pixels = torch.empty((ends[-1], 3), dtype=torch.uint8, device=image.device)
        pixels[ends[count - 1] - width * height : ends[count - 1]] = image.reshape(-1, 3)
    if not count == len(cameras) == captured or not count:
        raise ValueError(
            f"Reconstruction needs at least one view and as many images ({count}) and captured flags ({captured}) as "
            f"cameras ({len(cameras)})."
        )
    return pixels


def flat_maps(
    what: str, maps: Maps, shapes: Sequence[torch.Size], missing: float, dtype: torch.dtype = torch.float32
) -> Tensor | None:
    """(P,): the maps of all views one after another, `missing` for views without one; None without any."""
    if maps is None:
        return None
    if len(maps) != len(shapes):
        raise ValueError(f"There are {len(maps)} {what}s for {len(shapes)} images.")
    device = next((values.device for values in maps if values is not None), None)
    if device is None:
        return None
    flat = torch.full((sum(shape.numel() for shape in shapes),), missing, dtype=dtype, device=device)
    parts = flat.split([shape.numel() for shape in shapes])
    for index, (values, part, shape) in enumerate(zip(maps, parts, shapes, strict=True)):
        if values is not None:
            if values.shape != shape:
                raise ValueError(
                    f"The {what} of view {index} has shape {tuple(values.shape)}; its image is {tuple(shape)}."
                )
            part.copy_((values != 0 if dtype == torch.bool else values).reshape(-1))
    return flat


def flat_shares(what: str, maps: Maps, shapes: Sequence[torch.Size]) -> Tensor | None:
    """`flat_maps` of values that lie in [0, 1]."""
    flat = flat_maps(what, maps, shapes, 1.0)
    if flat is not None:
        for index, part in enumerate(flat.split([shape.numel() for shape in shapes])):
            if not bool(((part >= 0) & (part <= 1)).all()):
                raise ValueError(f"The {what} of view {index} has values outside [0, 1] (or NaN).")
    return flat
