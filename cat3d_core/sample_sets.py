"""Square samples of images that are not square: the paper's two sample sets.

'square': the largest centred square of the image. 'wide': the image padded to a square, whose generated views are
cropped back. (Paper: 'we combine square samples from square-cropped input views with wide samples cropped from input
views padded to be square'.)
"""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras

KINDS = ("square", "wide")


def source_boxes(size: Tensor, kind: str) -> Tensor:
    """(N, 3) int64 [x0, y0, side] of the square each image (width, height) is sampled from, in its pixels.

    'wide' boxes reach beyond the image (negative x0 or y0): fill with a constant. Odd margins go to the right and
    bottom. Raises ValueError for an unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"There is no sample kind {kind!r}; use 'square' or 'wide'.")
    side = size.amin(-1) if kind == "square" else size.amax(-1)
    corner = torch.div(size - side[:, None], 2, rounding_mode="floor" if kind == "square" else "trunc")
    return torch.cat([corner, side[:, None]], -1)


def sample_cameras(cameras: Cameras, kind: str, image_size: int) -> Cameras:
    """Cameras of the square samples of these images, resampled to image_size x image_size."""
    boxes = source_boxes(cameras.size, kind)
    return Cameras.cat(
        [
            cameras[i].crop(int(x0), int(y0), int(side), int(side)).resize(image_size, image_size)
            for i, (x0, y0, side) in enumerate(boxes)
        ]
    )


def kept_window(size: Tensor, kind: str, image_size: int) -> Tensor:
    """(N, 4) int64 [x0, y0, width, height]: the part of a sample that shows the image, not its padding.

    All of a square sample; of a wide one the whole pixels inside the image's rectangle.
    """
    if kind == "square":
        return torch.tensor([0, 0, image_size, image_size]).expand(len(size), 4).clone()
    boxes = source_boxes(size, kind)
    begin = (-boxes[:, :2]).double() * image_size / boxes[:, 2:]
    end = begin + size.double() * image_size / boxes[:, 2:]
    # A hair of slack so that 63.9999999 counts as 64.
    first, last = (begin - 1e-6).ceil().long(), (end + 1e-6).floor().long()
    return torch.cat([first, last - first], -1)
