"""The training views as one flat pixel buffer, and the batches of rays drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from cat3d_core.cameras import Cameras


class Views:
    """Posed images to reconstruct from: captured and generated ones, of any mixture of sizes.

    cameras: N cameras of the normalised scene (kept as float32). images: N uint8 tensors (H, W, 3), sRGB. captured (N,)
    bool. masks: N bool tensors (H, W), False where a pixel must not count; None for no masks, also per view.
    Raises ValueError, naming the view, where a shape or dtype does not fit its camera.
    """

    def __init__(
        self, cameras: Cameras, images: Sequence[Tensor], captured: Tensor, masks: Sequence[Tensor | None] | None = None
    ) -> None:
        if not len(images) == len(cameras) == len(captured) or not len(images):
            raise ValueError(
                f"Reconstruction needs at least one view and as many images ({len(images)}) and captured flags "
                f"({len(captured)}) as cameras ({len(cameras)})."
            )
        if masks is not None and len(masks) != len(images):
            raise ValueError(f"There are {len(masks)} masks for {len(images)} images.")
        for index, image in enumerate(images):
            width, height = cameras.size[index].tolist()
            if image.dtype != torch.uint8 or tuple(image.shape) != (height, width, 3):
                raise ValueError(
                    f"The image of view {index} is {image.dtype} {tuple(image.shape)}; its camera needs uint8 "
                    f"{(height, width, 3)}."
                )
            mask = masks[index] if masks is not None else None
            if mask is not None and tuple(mask.shape) != (height, width):
                raise ValueError(
                    f"The mask of view {index} has shape {tuple(mask.shape)}; its image is {(height, width)}."
                )
        self.cameras = cameras.to(dtype=torch.float32)
        self.captured = captured.to(torch.bool)
        self.size = cameras.size  # (N, 2) width, height
        pixels = cameras.size.prod(-1)
        self.offset = pixels.cumsum(0) - pixels
        self.pixels = torch.cat([image.reshape(-1, 3) for image in images])
        self._count(None)
        if masks is not None:
            whole = [
                torch.ones(image.shape[:2], dtype=torch.bool) if m is None else m
                for image, m in zip(images, masks, strict=True)
            ]
            self._count(torch.cat([m.reshape(-1).to(torch.bool) for m in whole]))

    def __len__(self) -> int:
        return len(self.offset)

    def to(self, device: torch.device | str) -> Views:
        """These views with their tensors on a device."""
        moved = object.__new__(Views)
        for name, value in vars(self).items():
            setattr(moved, name, None if value is None else value.to(device))
        return moved

    def image(self, view: int) -> Tensor:
        """(H, W, 3) uint8 of a view."""
        width, height = self.size[view].tolist()
        return self.pixels[int(self.offset[view]) :][: width * height].view(height, width, 3)

    def halved(self) -> Views:
        """The views at half the size (box filter; an odd last row or column is dropped, the cameras follow)."""
        images, masks = [], []
        cameras = []
        for index in range(len(self)):
            width, height = (int(side) // 2 for side in self.size[index])
            if not width or not height:
                raise ValueError(f"View {index} is too small to be halved; set low_resolution_iterations to 0.")
            span = slice(int(self.offset[index]), int(self.offset[index]) + int(self.size[index].prod()))
            whole = self.image(index)[: 2 * height, : 2 * width]
            small = functional.avg_pool2d(whole.permute(2, 0, 1).float(), 2).round().to(torch.uint8)
            images.append(small.permute(1, 2, 0).contiguous())
            cameras.append(self.cameras[index].crop(0, 0, 2 * width, 2 * height).resize(width, height))
            if self.valid is not None:
                valid = self.valid[span].view(int(self.size[index, 1]), int(self.size[index, 0]))[
                    : 2 * height, : 2 * width
                ]
                masks.append(functional.avg_pool2d(valid[None].float(), 2)[0] == 1)
        return Views(Cameras.cat(cameras), images, self.captured, masks or None).to(self.pixels.device)

    def without(self, batch: Batch) -> Views:
        """These views with the pixels of a batch masked out."""
        kept = torch.ones_like(self.pixels[:, 0], dtype=torch.bool)
        kept[self._index(batch.view, batch.xy)] = False
        return self.only(kept)

    def only(self, kept: Tensor) -> Views:
        """These views with all pixels masked out but `kept` (P,) bool, in the order of `pixels`."""
        views = self.to(self.pixels.device)
        views._count(kept if self.valid is None else self.valid & kept)
        return views

    def _count(self, valid: Tensor | None) -> None:
        """Let the pixels `valid` (P,) count, None for all. `counting` (N,) says how many those are of each view."""
        self.valid, self._places, self._begins = valid, None, self.offset
        self.counting = self.size.prod(-1)
        if valid is not None:
            ends = valid.cumsum(0)[self.offset + self.counting - 1]
            self._begins = torch.cat([ends.new_zeros(1), ends[:-1]])
            self.counting, self._places = ends - self._begins, valid.nonzero()[:, 0]

    def pixel(self, view: Tensor, number: Tensor) -> Tensor:
        """Integer pixels xy (R, 2): of those of views (R,) that count, row by row, the ones with these numbers (R,)."""
        index = self._begins[view] + number
        if self._places is not None:
            index = self._places[index]
        index, width = index - self.offset[view], self.size[view, 0]
        return torch.stack([index % width, index // width], -1)

    def _index(self, view: Tensor, xy: Tensor) -> Tensor:
        return self.offset[view] + xy[:, 1] * self.size[view, 0] + xy[:, 0]

    def colours(self, view: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
        """rgb (R, 3) in [0, 1] and validity (R,) float of integer pixels xy (R, 2) of views (R,)."""
        index = self._index(view, xy)
        rgb = self.pixels[index].float() / 255.0
        return rgb, torch.ones_like(rgb[:, 0]) if self.valid is None else self.valid[index].float()


@dataclass(frozen=True)
class Batch:
    """Rays to train on: view (R,), integer pixel xy (R, 2), rgb (R, 3), valid (R,). patch > 1: the rays are whole
    patch x patch squares, one after the other, row by row; patch = 1: single pixels."""

    view: Tensor
    xy: Tensor
    rgb: Tensor
    valid: Tensor
    patch: int


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
        return Batch(view, xy, *views.colours(view, xy), patch)
    room = views.size[view] - patch + 1
    corner = (torch.rand((patches, 2), generator=generator, device=view.device, dtype=torch.float64) * room).long()
    ticks = torch.arange(patch, device=view.device)
    within = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1).reshape(-1, 2)
    xy = (corner[:, None] + within).reshape(-1, 2)
    view = view.repeat_interleave(patch * patch)
    rgb, valid = views.colours(view, xy)
    return Batch(view, xy, rgb, valid, patch)
