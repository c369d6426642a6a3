"""The training views as one flat pixel buffer, and the batches of rays drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from cat3d_core.cameras import Cameras

Maps = Sequence[Tensor | None] | None


@dataclass(frozen=True)
class Views:
    """Posed images to reconstruct from: captured and generated ones, of any mixture of sizes; see `from_images`.

    cameras: N of the normalised scene, float32. captured (N,) bool. The P pixels of all views lie one view after
    another, row by row: pixels (P, 3) uint8, sRGB; valid (P,) bool, whether a pixel counts; weight (P,) in [0, 1], of
    its colour in the loss; inverse_depth (P,) and inverse_depth_weight (P,): what is known of 1 / z-depth, in scene
    units, weight 0 where nothing is. None: all pixels count, with weight 1; no depth is known.
    """

    cameras: Cameras
    captured: Tensor
    pixels: Tensor
    valid: Tensor | None = None
    weight: Tensor | None = None
    inverse_depth: Tensor | None = None
    inverse_depth_weight: Tensor | None = None

    @classmethod
    def from_images(
        cls, cameras: Cameras, images: Sequence[Tensor], captured: Tensor, masks: Maps = None, *,
        weights: Maps = None, depths: Maps = None, depth_weights: Maps = None,
    ) -> Views:  # fmt: skip
        """images: N uint8 tensors (H, W, 3), sRGB; captured (N,) bool. Maps (H, W) of each view, None for none, also
        for a single view: masks bool, False where a pixel must not count; weights in [0, 1] of the colours (such as the
        confidence of generated ones; 0: the pixel does not count); depths, z-depth in scene units (infinite: the sky; 0
        or NaN: unknown), with depth_weights in [0, 1] (1 by default).

        Raises ValueError, naming the view, where a shape, a dtype or a value does not fit.
        """
        if not len(images) == len(cameras) == len(captured) or not len(images):
            raise ValueError(
                f"Reconstruction needs at least one view and as many images ({len(images)}) and captured flags "
                f"({len(captured)}) as cameras ({len(cameras)})."
            )
        for index, image in enumerate(images):
            width, height = cameras.size[index].tolist()
            if image.dtype != torch.uint8 or tuple(image.shape) != (height, width, 3):
                raise ValueError(
                    f"The image of view {index} is {image.dtype} {tuple(image.shape)}; its camera needs uint8 "
                    f"{(height, width, 3)}."
                )
        shapes = [image.shape[:2] for image in images]
        mask = _flat("mask", masks, shapes, 1.0)
        weight = _shares("weight", weights, shapes)
        if weight is not None:
            mask = weight if mask is None else mask * weight
        depth = _flat("depth", depths, shapes, torch.nan)
        depth_weight = _shares("depth weight", depth_weights, shapes)
        inverse = None
        if depth is not None:
            known = depth > 0
            inverse = torch.where(known, 1.0 / torch.where(known, depth, 1.0), 0.0)
            depth_weight = known.float() if depth_weight is None else depth_weight * known
        return cls(
            cameras.to(dtype=torch.float32),
            captured.to(torch.bool),
            torch.cat([image.reshape(-1, 3) for image in images]),
            None if mask is None else mask != 0,
            weight,
            inverse,
            depth_weight if depth is not None else None,
        )

    def __len__(self) -> int:
        return len(self.captured)

    @property
    def size(self) -> Tensor:
        """(N, 2) width and height in pixels."""
        return self.cameras.size

    @cached_property
    def offset(self) -> Tensor:
        """(N,) where each view's pixels begin."""
        pixels = self.size.prod(-1)
        return pixels.cumsum(0) - pixels

    @cached_property
    def counting(self) -> Tensor:
        """(N,) how many pixels of each view count."""
        pixels = self.size.prod(-1)
        if self.valid is None:
            return pixels
        ends = self.valid.cumsum(0)[self.offset + pixels - 1]
        return ends.diff(prepend=ends.new_zeros(1))

    @cached_property
    def _places(self) -> Tensor | None:
        """Where the pixels that count are, None for everywhere."""
        return None if self.valid is None else self.valid.nonzero()[:, 0]

    @cached_property
    def _begins(self) -> Tensor:
        """(N,) how many pixels that count lie before each view."""
        return self.counting.cumsum(0) - self.counting

    def to(self, device: torch.device | str) -> Views:
        """These views with their tensors on a device."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        moved: dict[str, Any] = {name: value.to(device) for name, value in fields.items() if value is not None}
        return Views(**moved)

    def image(self, view: int) -> Tensor:
        """(H, W, 3) uint8 of a view."""
        return self.map(self.pixels, view)

    def map(self, values: Tensor, view: int) -> Tensor:
        """(H, W, ...) of a view, from what all pixels have, (P, ...)."""
        width, height = self.size[view].tolist()
        return values[int(self.offset[view]) :][: width * height].unflatten(0, (height, width))

    def halved(self) -> Views:
        """The views at half the size (box filter; an odd last row or column is dropped, the cameras follow)."""
        cameras: list[Cameras] = []
        maps: dict[str, list[Tensor]] = {name: [] for name in _MAPS if getattr(self, name) is not None}
        for index in range(len(self)):
            width, height = (int(side) // 2 for side in self.size[index])
            if not width or not height:
                raise ValueError(f"View {index} is too small to be halved; set low_resolution_iterations to 0.")
            cameras.append(self.cameras[index].crop(0, 0, 2 * width, 2 * height).resize(width, height))
            whole = {name: self.map(getattr(self, name), index) for name in maps}
            if "inverse_depth" in maps:  # what is not known has no part in the mean
                whole["inverse_depth"] = whole["inverse_depth"] * whole["inverse_depth_weight"]
            for name, values in whole.items():
                maps[name].append(_halved(values).flatten(0, 1))
        flat = {name: torch.cat(parts) for name, parts in maps.items()}
        flat["pixels"] = flat["pixels"].round().to(torch.uint8)
        if "valid" in flat:
            flat["valid"] = flat["valid"] == 1
        if "inverse_depth" in flat:
            known = flat["inverse_depth_weight"]
            flat["inverse_depth"] = flat["inverse_depth"] / known.where(known > 0, 1.0)
        return Views(Cameras.cat(cameras), self.captured, **flat)

    def without(self, batch: Batch) -> Views:
        """These views with the pixels of a batch masked out."""
        kept = torch.ones_like(self.pixels[:, 0], dtype=torch.bool)
        kept[self.index(batch.view, batch.xy)] = False
        return self.only(kept)

    def only(self, kept: Tensor) -> Views:
        """These views with all pixels masked out but `kept` (P,) bool, in the order of `pixels`."""
        return dataclasses.replace(self, valid=kept if self.valid is None else self.valid & kept)

    def pixel(self, view: Tensor, number: Tensor) -> Tensor:
        """Integer pixels xy (R, 2): of those of views (R,) that count, row by row, the ones with these numbers (R,)."""
        index = self._begins[view] + number
        if self._places is not None:
            index = self._places[index]
        index, width = index - self.offset[view], self.size[view, 0]
        return torch.stack([index % width, index // width], -1)

    def index(self, view: Tensor, xy: Tensor) -> Tensor:
        """Where the integer pixels xy (R, 2) of views (R,) lie in `pixels`."""
        return self.offset[view] + xy[:, 1] * self.size[view, 0] + xy[:, 0]

    def batch(self, view: Tensor, xy: Tensor, patch: int) -> Batch:
        """The integer pixels xy (R, 2) of views (R,), see `Batch`."""
        index = self.index(view, xy)
        rgb = self.pixels[index].float() / 255.0
        valid = torch.ones_like(rgb[:, 0]) if self.valid is None else self.valid[index].float()
        weight = valid if self.weight is None else valid * self.weight[index]
        depth = None if self.inverse_depth is None else self.inverse_depth[index]
        depth_weight = None if self.inverse_depth_weight is None else self.inverse_depth_weight[index]
        return Batch(view, xy, rgb, valid, weight, depth, depth_weight, patch)


#: The fields of Views that every pixel has a value of.
_MAPS = ("pixels", "valid", "weight", "inverse_depth", "inverse_depth_weight")


def _halved(values: Tensor) -> Tensor:
    """Means (h, w, ...) float32 of squares of two pixels' side of (H, W, ...)."""
    planes = values.float().reshape(*values.shape[:2], -1).permute(2, 0, 1)
    return functional.avg_pool2d(planes, 2).permute(1, 2, 0).reshape(-1, values.shape[1] // 2, *values.shape[2:])


def _flat(what: str, maps: Maps, shapes: Sequence[torch.Size], missing: float) -> Tensor | None:
    """(P,) float32: the maps of all views one after another, `missing` for views without one; None without any."""
    if maps is None:
        return None
    if len(maps) != len(shapes):
        raise ValueError(f"There are {len(maps)} {what}s for {len(shapes)} images.")
    for index, (values, shape) in enumerate(zip(maps, shapes, strict=True)):
        if values is not None and values.shape != shape:
            raise ValueError(
                f"The {what} of view {index} has shape {tuple(values.shape)}; its image is {tuple(shape)}."
            )
    whole = (torch.full(shape, missing) if m is None else m.float() for m, shape in zip(maps, shapes, strict=True))
    return torch.cat([values.reshape(-1) for values in whole])


def _shares(what: str, maps: Maps, shapes: Sequence[torch.Size]) -> Tensor | None:
    """`_flat` of values that lie in [0, 1]."""
    flat = _flat(what, maps, shapes, 1.0)
    if flat is not None:
        for index, part in enumerate(flat.split([shape.numel() for shape in shapes])):
            if not bool(((part >= 0) & (part <= 1)).all()):
                raise ValueError(f"The {what} of view {index} has values outside [0, 1] (or NaN).")
    return flat


@dataclass(frozen=True)
class Batch:
    """Rays to train on: view (R,), integer pixel xy (R, 2), rgb (R, 3) in [0, 1], valid (R,) 0 or 1, weight (R,) of the
    colour (0 where not valid), inverse_depth (R,) and its weight (R,) where the views know depths. patch > 1: the rays
    are whole patch x patch squares, one after the other, row by row; patch = 1: single pixels."""

    view: Tensor
    xy: Tensor
    rgb: Tensor
    valid: Tensor
    weight: Tensor
    inverse_depth: Tensor | None
    inverse_depth_weight: Tensor | None
    patch: int

    def part(self, rays: slice) -> Batch:
        """Some of the rays."""
        parts: dict[str, Any] = {n: v[rays] for n, v in vars(self).items() if isinstance(v, Tensor)}
        return dataclasses.replace(self, **parts)


def draw_views(views: Views, count: int, captured_share: float, generator: torch.Generator) -> Tensor:
    """`count` views, each as often as it has pixels that count, of all of its own; but captured views together have at
    least the probability `captured_share`."""
    whole = views.counting / views.size.prod(-1)
    captured, generated = whole * views.captured, whole * ~views.captured
    share = captured.sum() / whole.sum().clamp_min(1e-9)
    if 0 < share < 1:
        share = share.clamp_min(captured_share)
    probability = captured * share / captured.sum().clamp_min(1e-9)
    probability = probability + generated * (1 - share) / generated.sum().clamp_min(1e-9)
    if not probability.any():  # no pixel counts: there is nothing to learn, and nothing to fail at
        probability = torch.ones_like(probability)
    return torch.multinomial(probability, count, replacement=True, generator=generator)


def draw_batch(views: Views, patches: int, patch: int, captured_share: float, generator: torch.Generator) -> Batch:
    """Draw squares of `patch` pixels wholly inside views, each view and corner at random; or (1) single pixels, each of
    those that count.

    Raises ValueError where a view is smaller than the patch.
    """
    smallest = int(views.size.min())
    if patch > smallest:
        raise ValueError(
            f"Patches of {patch} pixels do not fit a view whose shorter side is {smallest}; lower patch_size."
        )
    view = draw_views(views, patches, captured_share, generator)
    if patch == 1 and views.valid is not None and views.counting.any():
        number = torch.rand(patches, generator=generator, device=view.device, dtype=torch.float64)
        xy = views.pixel(view, (number * views.counting[view]).long())
        return views.batch(view, xy, patch)
    room = views.size[view] - patch + 1
    corner = (torch.rand((patches, 2), generator=generator, device=view.device, dtype=torch.float64) * room).long()
    ticks = torch.arange(patch, device=view.device)
    within = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1).reshape(-1, 2)
    xy = (corner[:, None] + within).reshape(-1, 2)
    return views.batch(view.repeat_interleave(patch * patch), xy, patch)
