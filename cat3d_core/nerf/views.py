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
        self.valid = None
        if masks is not None:
            whole = [
                torch.ones(image.shape[:2], dtype=torch.bool) if m is None else m
                for image, m in zip(images, masks, strict=True)
            ]
            self.valid = torch.cat([m.reshape(-1).to(torch.bool) for m in whole])

    def __len__(self) -> int:
        return len(self.offset)

    def to(self, device: torch.device | str) -> Views:
        """These views with their tensors on a device."""
        moved = object.__new__(Views)
        for name, value in vars(self).items():
            setattr(moved, name, None if value is None else value.to(device))
        return moved

    def halved(self) -> Views:
        """The views at half the size (box filter; an odd last row or column is dropped, the cameras follow)."""
        images, masks = [], []
        cameras = []
        for index in range(len(self)):
            width, height = (int(side) // 2 for side in self.size[index])
            if not width or not height:
                raise ValueError(f"View {index} is too small to be halved; set low_resolution_iterations to 0.")
            span = slice(int(self.offset[index]), int(self.offset[index]) + int(self.size[index].prod()))
            whole = self.pixels[span].view(int(self.size[index, 1]), int(self.size[index, 0]), 3)[
                : 2 * height, : 2 * width
            ]
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
        views = self.to(self.pixels.device)
        views.valid = torch.ones_like(self.pixels[:, 0], dtype=torch.bool) if self.valid is None else self.valid.clone()
        views.valid[self._index(batch.view, batch.xy)] = False
        return views

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


def _draw_views(views: Views, count: int, captured_share: float, generator: torch.Generator) -> Tensor:
    """`count` views: uniform, but captured views together have at least the probability `captured_share`."""
    captured = views.captured.float()
    number = captured.sum()
    share = (number / len(captured)).clamp_min(captured_share) if 0 < number < len(captured) else number / len(captured)
    probability = captured * share / number.clamp_min(1) + (1 - captured) * (1 - share) / (
        len(captured) - number
    ).clamp_min(1)
    return torch.multinomial(probability, count, replacement=True, generator=generator)


def draw_batch(views: Views, patches: int, patch: int, captured_share: float, generator: torch.Generator) -> Batch:
    """Draw squares of `patch` pixels (1: single pixels) wholly inside views, each view and corner at random.

    Raises ValueError where a view is smaller than the patch.
    """
    smallest = int(views.size.min())
    if patch > smallest:
        raise ValueError(
            f"Patches of {patch} pixels do not fit a view whose shorter side is {smallest}; lower patch_size."
        )
    view = _draw_views(views, patches, captured_share, generator)
    room = views.size[view] - patch + 1
    corner = (torch.rand((patches, 2), generator=generator, device=view.device, dtype=torch.float64) * room).long()
    ticks = torch.arange(patch, device=view.device)
    within = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1).reshape(-1, 2)
    xy = (corner[:, None] + within).reshape(-1, 2)
    view = view.repeat_interleave(patch * patch)
    rgb, valid = views.colours(view, xy)
    return Batch(view, xy, rgb, valid, patch)
