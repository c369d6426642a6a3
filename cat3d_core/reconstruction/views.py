"""The training views as one flat pixel buffer, and the batches of rays drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from cat3d_core.cameras import Cameras
from cat3d_core.rays import Pinholes
from cat3d_core.reconstruction.buffers import Maps, flat_maps, flat_shares, pixel_buffer


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
        cls, cameras: Cameras, images: Iterable[Tensor], captured: Tensor, masks: Maps = None, *,
        weights: Maps = None, depths: Maps = None, depth_weights: Maps = None,
    ) -> Views:  # fmt: skip
        """images: N uint8 tensors (H, W, 3), sRGB, taken one at a time, so that they need not be in memory together;
        captured (N,) bool. Maps (H, W) of each view, None for none, also for a single view: masks bool, False where a
        pixel must not count; weights in [0, 1] of the colours (such as the confidence of generated ones; 0: the pixel
        does not count); depths, z-depth in scene units (infinite: the sky; 0 or NaN: unknown), with depth_weights in
        [0, 1] (1 by default).

        Raises ValueError, naming the view, where a shape, a dtype or a value does not fit.
        """
        pixels = pixel_buffer(cameras, images, len(captured))
        shapes = [torch.Size((height, width)) for width, height in cameras.size.tolist()]
        valid = flat_maps("mask", masks, shapes, True, torch.bool)
        weight = flat_shares("weight", weights, shapes)
        if weight is not None:
            valid = weight != 0 if valid is None else valid & (weight != 0)
        depth = flat_maps("depth", depths, shapes, torch.nan)
        depth_weight = flat_shares("depth weight", depth_weights, shapes)
        inverse = None
        if depth is not None:
            known = depth > 0
            inverse = torch.where(known, 1.0 / torch.where(known, depth, 1.0), 0.0)
            depth_weight = known.float() if depth_weight is None else depth_weight * known
        return cls(
            cameras.to(dtype=torch.float32),
            captured.to(torch.bool),
            pixels,
            valid,
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
    def pinholes(self) -> Pinholes:
        """What the rays of the cameras follow from."""
        return Pinholes.of(self.cameras)

    @cached_property
    def shares(self) -> tuple[Tensor, Tensor, Tensor]:
        """How captured and generated views share draws among themselves, (N,) both, each as often as it has pixels that
        count, of all of its own; and the captured ones' share of all."""
        whole = self.counting / self.size.prod(-1)
        captured, generated = whole * self.captured, whole * ~self.captured
        share = captured.sum() / whole.sum().clamp_min(1e-9)
        return captured / captured.sum().clamp_min(1e-9), generated / generated.sum().clamp_min(1e-9), share

    @cached_property
    def offset(self) -> Tensor:
        """(N,) where each view's pixels begin."""
        pixels = self.size.prod(-1)
        return pixels.cumsum(0) - pixels

    @cached_property
    def counting(self) -> Tensor:
        """(N,) how many pixels of each view count."""
        pixels = self.size.prod(-1)
        return pixels if self.valid is None else self._before(self.offset + pixels) - self._begins

    @cached_property
    def _begins(self) -> Tensor:
        """(N,) how many pixels that count lie before each view."""
        return self._before(self.offset)

    @cached_property
    def _blocks(self) -> Tensor:
        """How many pixels that count lie before each block of _BLOCK pixels, and in all: places of single pixels would
        take eight bytes for each."""
        assert self.valid is not None
        whole = len(self.valid) // _BLOCK * _BLOCK
        # In parts: to be summed, truth values are turned into integers of eight bytes.
        counts = [part.view(-1, _BLOCK).sum(1) for part in self.valid[:whole].split(_BLOCK << 18)]
        return torch.cat([self.offset.new_zeros(1), *counts, self.valid[whole:].sum()[None]]).cumsum(0)

    def _block(self, block: Tensor) -> Tensor:
        """(R, _BLOCK) bool: which pixels of blocks (R,) count."""
        assert self.valid is not None
        index = block[:, None] * _BLOCK + torch.arange(_BLOCK, device=block.device)
        return self.valid[index.clamp(max=len(self.valid) - 1)] & (index < len(self.valid))

    def _before(self, index: Tensor) -> Tensor:
        """How many pixels that count lie before these places (R,) in `pixels`."""
        if self.valid is None:
            return index
        block, within = index // _BLOCK, index % _BLOCK
        earlier = torch.arange(_BLOCK, device=index.device) < within[:, None]
        return self._blocks[block] + (self._block(block) & earlier).sum(1)

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
        if self.valid is not None:
            block = torch.searchsorted(self._blocks, index, right=True) - 1
            inside = self._block(block).cumsum(1, dtype=torch.uint8)
            left = index - self._blocks[block]
            index = block * _BLOCK + (inside > left[:, None]).to(torch.uint8).argmax(1)
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


#: Pixels that are counted together, so that the one with a given number is found by looking at one block.
_BLOCK = 32
#: The fields of Views that every pixel has a value of.
_MAPS = ("pixels", "valid", "weight", "inverse_depth", "inverse_depth_weight")


def _halved(values: Tensor) -> Tensor:
    """Means (h, w, ...) float32 of squares of two pixels' side of (H, W, ...)."""
    planes = values.float().reshape(*values.shape[:2], -1).permute(2, 0, 1)
    return functional.avg_pool2d(planes, 2).permute(1, 2, 0).reshape(-1, values.shape[1] // 2, *values.shape[2:])


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
    captured, generated, share = views.shares
    if 0 < share < 1:
        share = share.clamp_min(captured_share)
    probability = captured * share + generated * (1 - share)
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
