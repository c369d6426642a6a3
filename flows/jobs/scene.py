"""A scene where it lies: read once and its photos hashed once, however many jobs and stages ask."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from flows.readers.base import FRAMES, Capture, read_capture
from schemas.content_key import array_digest, file_sha256


@dataclass(frozen=True)
class Scene:
    """Where a scene is read from (see `read_capture`), and what was found there when it was first asked for."""

    source: str
    reader: str = "auto"
    image_folder: str | None = None
    frames: int = FRAMES

    @cached_property
    def capture(self) -> Capture:
        """The scene as its reader found it. Raises InputError for everything a user can correct."""
        return read_capture(self.source, self.reader, self.image_folder, frames=self.frames)

    @cached_property
    def digests(self) -> dict[str, Any]:
        """Digests of what the capture brings, see `capture_digests`."""
        return capture_digests(self.capture)


def capture_digests(capture: Capture) -> dict[str, Any]:
    """Digests of what a capture brings: "images" {name: sha256}, "lens" (intrinsics, distortion, masks), "cameras"."""
    if capture.image_digests is not None:
        images = dict(zip(capture.names, capture.image_digests))
    elif capture.images is not None:
        images = {name: array_digest(image) for name, image in zip(capture.names, capture.images)}
    else:
        images = {name: file_sha256(path) for name, path in zip(capture.names, capture.paths)}
    masks = [None if m is None else file_sha256(m) for m in capture.masks]
    cameras = capture.cameras

    def digest(tensor: Tensor | None) -> str | None:
        return None if tensor is None else array_digest(tensor.numpy())

    # Only where they say something, so that the keys of all other scenes stay what they were.
    unusual: dict[str, Any] = {} if capture.upright else {"upright": False}
    if capture.fisheye is not None:
        unusual["fisheye"] = digest(capture.fisheye)
    if capture.mask_training:
        unusual["mask_training"] = True
    return {
        "images": images,
        "lens": {
            "intrinsics": digest(cameras.intrinsics) if cameras else None,
            "distortion": digest(capture.distortion),
            "masks": masks,
        }
        | unusual,
        "cameras": {
            "poses": digest(cameras.world_from_camera) if cameras else None,
            "points": digest(capture.points),
            "depth_bounds": digest(capture.depth_bounds),
        },
    }
