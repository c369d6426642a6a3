"""A scene as Gaussians: what 3D Gaussian splatting (Kerbl et al. 2023) stores of each, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from cat3d_core.normalization import Similarity
from cat3d_core.quaternions import quaternion_product, quaternions_from_rotations, rotation_matrices

# Real spherical harmonics of degrees 0, 1 and 2 with the signs and order of the 3DGS files.
SH_0 = 0.5 / math.sqrt(math.pi)
SH_1 = math.sqrt(3 / (4 * math.pi))
SH_2 = math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi))
MAX_DEGREE = 2


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians of density exp(-1/2 (x - mean)^T covariance^-1 (x - mean)), covariance = R diag(scale)^2 R^T.

    means (N, 3) in scene units; quaternions (N, 4) w, x, y, z of R, of any length but 0; log_scales (N, 3), natural
    logarithms of the standard deviations along R's columns; logits (N,) of the opacity at the mean; harmonics
    (N, (degree + 1)^2, 3): coefficients of the colour, degree 0 to 2. Raises ValueError for shapes that do not fit.
    """

    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    logits: Tensor
    harmonics: Tensor

    def __post_init__(self) -> None:
        count, terms = len(self.means), [(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]
        shapes = {"means": (count, 3), "quaternions": (count, 4), "log_scales": (count, 3), "logits": (count,)}
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"Gaussians.{name} has shape {tuple(getattr(self, name).shape)}; expected {shape}.")
        shape = tuple(self.harmonics.shape)
        if len(shape) != 3 or shape[0] != count or shape[1] not in terms or shape[2] != 3:
            raise ValueError(f"Gaussians.harmonics has shape {shape}; expected ({count}, one of {terms}, 3).")

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """Some of the Gaussians."""
        return Gaussians(**{name: value[index] for name, value in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """The five tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> Gaussians:
        """The Gaussians of `tensors()`; other names are passed over. Raises ValueError where one is missing."""
        names = [field.name for field in fields(Gaussians)]
        missing = [name for name in names if name not in tensors]
        if missing:
            raise ValueError(f"These are not the tensors of Gaussians: {', '.join(missing)} missing.")
        return Gaussians(**{name: tensors[name] for name in names})

    @staticmethod
    def cat(parts: Iterator[Gaussians] | list[Gaussians]) -> Gaussians:
        """All Gaussians of several, which are of one degree."""
        rows = [part.tensors() for part in parts]
        return Gaussians(**{name: torch.cat([row[name] for row in rows]) for name in rows[0]})

    def detach(self) -> Gaussians:
        """The same without gradient."""
        return Gaussians(**{name: value.detach() for name, value in self.tensors().items()})

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """Moved, or in another dtype."""
        return Gaussians(**{name: value.to(device=device, dtype=dtype) for name, value in self.tensors().items()})

    @property
    def degree(self) -> int:
        """Degree of the colour's spherical harmonics."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def opacities(self) -> Tensor:
        """(N,) opacity at the mean, 0 to 1."""
        return self.logits.sigmoid()

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations in scene units."""
        return self.log_scales.exp()

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations R."""
        return rotation_matrices(self.quaternions)

    @property
    def covariances(self) -> Tensor:
        """(N, 3, 3)."""
        factor = self.rotations * self.scales[:, None, :]
        return factor @ factor.transpose(1, 2)

    def colours(self, viewpoint: Tensor) -> Tensor:
        """(N, 3) colours seen from a point (3,), at least 0. No gradient flows to the means."""
        directions = normalize(self.means.detach() - viewpoint, dim=-1)
        return (0.5 + (basis(directions, self.degree)[..., None] * self.harmonics).sum(1)).clamp_min(0.0)

    def normals(self, viewpoint: Tensor) -> Tensor:
        """(N, 3) unit vectors along the shortest axes, towards a point (3,)."""
        shortest = self.log_scales.argmin(1)
        axis = self.rotations.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
        away = (axis * (self.means - viewpoint)).sum(-1, keepdim=True) > 0
        return torch.where(away, -axis, axis)

    def mapped(self, similarity: Similarity) -> Gaussians:
        """The Gaussians in another frame: means, scales, rotations and the directions of their colours follow."""
        rotation = similarity.rotation.to(self.means)
        turn = quaternions_from_rotations(rotation[None].double()).to(self.means)
        return replace(
            self,
            means=similarity.points(self.means),
            quaternions=quaternion_product(turn, self.quaternions),
            log_scales=self.log_scales + math.log(similarity.scale),
            harmonics=rotated_harmonics(self.harmonics, rotation),
        )


def basis(directions: Tensor, degree: int) -> Tensor:
    """(..., (degree + 1)^2) real spherical harmonics of unit directions (..., 3)."""
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, SH_0)]
    if degree >= 1:
        terms += [-SH_1 * y, SH_1 * z, -SH_1 * x]
    if degree >= 2:
        a, b, c = SH_2
        terms += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    return torch.stack(terms, -1)


def rotated_harmonics(harmonics: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients (N, K, 3) of the same colours when everything is turned by the rotation (3, 3).

    Each degree turns within itself by the matrix that takes the basis at some directions to the basis at the turned
    ones, found by least squares (exact, as there are more directions than terms).
    """
    degree = math.isqrt(harmonics.shape[1]) - 1
    out = [harmonics[:, :1]]
    spread = torch.randn((32, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = normalize(spread, dim=-1).to(rotation.device)
    for level in range(1, degree + 1):
        rows = slice(level**2, (level + 1) ** 2)
        before = basis(directions, level)[:, rows]
        after = basis(directions @ rotation.double().T, level)[:, rows]
        turn = torch.linalg.lstsq(after, before).solution.to(harmonics)  # after @ turn = before
        out.append(torch.einsum("ij,njc->nic", turn, harmonics[:, rows]))
    return torch.cat(out, 1)


def harmonics_of_colour(colour: Tensor, degree: int = 0) -> Tensor:
    """(N, K, 3) coefficients of colours (N, 3) that are the same from all sides."""
    harmonics = colour.new_zeros((len(colour), (degree + 1) ** 2, 3))
    harmonics[:, 0] = (colour - 0.5) / SH_0
    return harmonics
