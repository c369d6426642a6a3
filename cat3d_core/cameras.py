"""Batches of pinhole cameras. (The similarity that normalises a scene is in normalization.py.)

Conventions, stated once: OpenCV camera axes (x right, y down, z forward); `world_from_camera` maps camera to world
points; `intrinsics` in pixels; the centre of the pixel in column i, row j is (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """N pinhole cameras, each with its own intrinsics and image size.

    intrinsics (N, 3, 3) in pixels; world_from_camera (N, 4, 4), rigid; size (N, 2) int64, [width, height] in pixels.
    """

    intrinsics: Tensor
    world_from_camera: Tensor
    size: Tensor

    def __post_init__(self) -> None:
        count = self.intrinsics.shape[0]
        expected = {"intrinsics": (count, 3, 3), "world_from_camera": (count, 4, 4), "size": (count, 2)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"Cameras.{name} has shape {tuple(getattr(self, name).shape)}; expected {shape}.")

    def __len__(self) -> int:
        return self.intrinsics.shape[0]

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> Cameras:
        """A sub-batch; an integer gives a batch of one."""
        if isinstance(index, int):
            index = [index]
        if not isinstance(index, (slice, Tensor)):
            index = torch.as_tensor(list(index), dtype=torch.long)
        return Cameras(self.intrinsics[index], self.world_from_camera[index], self.size[index])

    @staticmethod
    def cat(batches: Sequence[Cameras]) -> Cameras:
        """Join batches along the camera axis."""
        return Cameras(
            torch.cat([b.intrinsics for b in batches]),
            torch.cat([b.world_from_camera for b in batches]),
            torch.cat([b.size for b in batches]),
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        """Move the cameras; `dtype` applies to the floating-point parts, `size` stays int64."""
        return Cameras(
            self.intrinsics.to(device=device, dtype=dtype),
            self.world_from_camera.to(device=device, dtype=dtype),
            self.size.to(device=device),
        )

    @property
    def rotation(self) -> Tensor:
        """(N, 3, 3) camera-to-world rotations; columns are the camera's right, down and forward axes in the world."""
        return self.world_from_camera[:, :3, :3]

    @property
    def centers(self) -> Tensor:
        """(N, 3) optical centres in the world."""
        return self.world_from_camera[:, :3, 3]

    @property
    def forward(self) -> Tensor:
        """(N, 3) unit viewing directions in the world."""
        return self.world_from_camera[:, :3, 2]

    @property
    def up(self) -> Tensor:
        """(N, 3) unit directions of the image's top edge in the world (minus the camera's y axis)."""
        return -self.world_from_camera[:, :3, 1]

    @property
    def camera_from_world(self) -> Tensor:
        """(N, 4, 4) inverse poses, by transposing the rotation (exact for rigid poses)."""
        inverse_rotation = self.rotation.transpose(1, 2)
        out = torch.zeros_like(self.world_from_camera)
        out[:, :3, :3] = inverse_rotation
        out[:, :3, 3] = -(inverse_rotation @ self.centers[..., None])[..., 0]
        out[:, 3, 3] = 1
        return out

    def project(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        """Project P world points into every camera.

        points_world (P, 3) -> pixels (N, P, 2) and z-depth (N, P). Pixels mean nothing where depth <= 0; there the
        division is by a tiny positive number instead, so that nothing becomes infinite or NaN.
        """
        view = self.camera_from_world
        points_camera = points_world[None] @ view[:, :3, :3].transpose(1, 2) + view[:, None, :3, 3]
        depth = points_camera[..., 2]
        image = points_camera @ self.intrinsics.transpose(1, 2)
        tiny = torch.finfo(depth.dtype).tiny ** 0.5
        return image[..., :2] / depth.clamp(min=tiny)[..., None], depth

    def crop(self, x0: int, y0: int, width: int, height: int) -> Cameras:
        """Cameras of the window whose top-left pixel is (x0, y0); the ray of each kept pixel is unchanged.

        Raises ValueError when the window is empty. Negative offsets pad (see `pad`).
        """
        if width <= 0 or height <= 0:
            raise ValueError(f"A crop of {width} x {height} pixels is empty; both sides must be positive.")
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0, 2] -= x0
        intrinsics[:, 1, 2] -= y0
        size = torch.tensor([width, height], device=self.size.device).expand(len(self), 2).clone()
        return replace(self, intrinsics=intrinsics, size=size)

    def pad(self, left: int, top: int, right: int, bottom: int) -> Cameras:
        """Cameras of the image with borders added; the ray of each old pixel is unchanged."""
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 0, 2] += left
        intrinsics[:, 1, 2] += top
        extra = torch.tensor([left + right, top + bottom], device=self.size.device)
        return replace(self, intrinsics=intrinsics, size=self.size + extra)

    def resize(self, width: int, height: int) -> Cameras:
        """Cameras of the image resampled to width x height (the whole image area maps onto the whole image area)."""
        if width <= 0 or height <= 0:
            raise ValueError(f"Cannot resize to {width} x {height} pixels; both sides must be positive.")
        target = torch.tensor([width, height], device=self.size.device)
        factors = target.to(self.intrinsics) / self.size.to(self.intrinsics)
        intrinsics = self.intrinsics.clone()
        intrinsics[:, :2] *= factors[:, :, None]
        return replace(self, intrinsics=intrinsics, size=target.expand(len(self), 2).clone())

    def validate(self, names: Sequence[str] | None = None) -> None:
        """Raise ValueError, naming the view, unless every camera is finite, rigid and has a positive focal length."""
        for i in range(len(self)):
            fault = _camera_fault(self.intrinsics[i].double(), self.world_from_camera[i].double(), self.size[i])
            if fault:
                who = names[i] if names is not None else f"number {i}"
                raise ValueError(f"The camera of view {who} {fault}")


def _camera_fault(k: Tensor, pose: Tensor, size: Tensor) -> str | None:
    if not torch.isfinite(pose).all():
        return "has a NaN or infinite number in its pose; correct or remove that view."
    if not torch.isfinite(k).all():
        return "has a NaN or infinite number in its intrinsics; correct or remove that view."
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        return f"has a focal length of {k[0, 0]:g} x {k[1, 1]:g} pixels; both must be positive."
    if (size <= 0).any():
        return f"has an image size of {size[0]} x {size[1]} pixels; both must be positive."
    rotation = pose[:3, :3]
    error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if error > 1e-3:
        return (
            f"has a pose whose 3x3 part is not a rotation (R R^T differs from the identity by {error:.2g}); "
            "a scaled or sheared pose cannot be used."
        )
    if torch.linalg.det(rotation) < 0:
        return "has a mirrored pose (determinant -1); one of its axes points the wrong way."
    if (pose[3] - torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)).abs().max() > 1e-6:
        return "has a pose whose last row is not 0 0 0 1."
    return None


def orthonormalize(world_from_camera: Tensor) -> Tensor:
    """The poses with each 3x3 part replaced by the nearest rotation (SVD), for poses stored with few digits.

    world_from_camera (N, 4, 4) -> the same shape. Done once at the border; `validate` should have passed before.
    """
    u, _, vh = torch.linalg.svd(world_from_camera[:, :3, :3])
    out = world_from_camera.clone()
    out[:, :3, :3] = u @ vh
    return out
