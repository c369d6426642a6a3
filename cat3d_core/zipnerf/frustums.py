"""Cone multisampling: each ray interval becomes a few isotropic Gaussians that match the frustum's moments (Zip-NeRF
sec. 2)."""

from __future__ import annotations

import ctypes
import functools
import math

import torch
from torch import Tensor

from cat3d_core.cpu_library import library, pointer
from cat3d_core.rays import Rays, perpendicular_basis
from cat3d_core.zipnerf.coordinates import contract, contracted_std

# Around the cone in an order that decorrelates angle from depth (Zip-NeRF's 'hexify'); three samples take every second
# one.
_TURNS = {6: (0, 2, 4, 3, 5, 1), 3: (0, 2, 4)}


def sample_distances(t: Tensor, count: int = 6) -> Tensor:
    """Distances (R, N, count) along the ray of the samples of intervals with edges t (R, N+1), t >= 0 non-decreasing.

    Zip-NeRF eq. 2, written in q = half width / centre so that neither t = 0 nor t = 1e6 loses accuracy. Their mean and
    variance are those of a uniform cone frustum; for counts other than 6 the spread is rescaled to keep that variance.
    """
    centre = 0.5 * (t[..., 1:] + t[..., :-1])
    half = 0.5 * (t[..., 1:] - t[..., :-1])
    q = (half / centre.clamp_min(torch.finfo(t.dtype).tiny))[..., None]
    steps = torch.linspace(-1.0, 1.0, count, dtype=t.dtype, device=t.device)
    spread = steps * (math.sqrt(0.6) / steps.square().mean().sqrt())
    shape = (1.0 + q).square() + 2.0 + spread * ((q.square() - 1.0).square() + 4.0).sqrt()
    return t[..., :-1, None] + centre[..., None] * (q / (q.square() + 3.0)) * shape


def cone_samples(
    origins: Tensor,
    directions: Tensor,
    radii: Tensor,
    t: Tensor,
    count: int = 6,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Gaussians that stand for the frusta of rays: means (R, N, count, 3) and standard deviations (R, N, count), scene
    units.

    origins, directions (R, 3) (camera z = 1, not unit), radii (R, 1) of the cone at t = 1, edges t (R, N+1). Samples
    lie on a spiral of radius r t / sqrt(2). With a generator (training) each interval's spiral is flipped and turned at
    random; without, every odd interval is flipped and turned by 30 degrees, so rendering is deterministic.
    Raises ValueError for a count other than 6 (the paper) or 3 (half the cost).
    """
    angle = _turns(count, t)
    flip, turn = _spirals(t, generator)
    # Flipping the order of samples along the ray turns the spiral the other way.
    along = sample_distances(t, count)
    along = torch.where(flip[..., None] > 0.5, along.flip(-1), along)
    angle = angle + turn[..., None]
    radius = radii[..., None] * along * math.sqrt(0.5)
    first, second = perpendicular_basis(directions)[:, None, None].unbind(-2)
    means = torch.addcmul(origins[:, None, None], directions[:, None, None], along[..., None])
    means = torch.addcmul(means, first, (radius * angle.cos()).expand_as(along)[..., None])
    means = torch.addcmul(means, second, (radius * angle.sin()).expand_as(along)[..., None])
    return means, 0.5 * radius


def _turns(count: int, t: Tensor) -> Tensor:
    if count not in _TURNS:
        raise ValueError(f"Cone multisampling knows 6 or 3 samples per interval, got {count}.")
    return torch.tensor(_TURNS[count], dtype=t.dtype, device=t.device) * (math.pi / 3)


@functools.cache
def _pattern(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """What the kernel needs of an interval's samples, (count): spread along the ray, cosine and sine of the turn."""
    steps, turns = torch.linspace(-1.0, 1.0, count), _turns(count, torch.zeros(()))
    return steps * (math.sqrt(0.6) / steps.square().mean().sqrt()), turns.cos(), turns.sin()


def _spirals(t: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Whether (> 0.5) each interval's spiral is flipped, and its turn in radians, (R, N) both."""
    shape = t.shape[:-1] + (t.shape[-1] - 1,)
    if generator is None:
        odd = (torch.arange(shape[-1], device=t.device) % 2).to(t.dtype).expand(shape)
        return odd, odd * (math.pi / 6)
    draw = torch.rand((2, *shape), generator=generator, dtype=t.dtype, device=t.device)
    return (draw[0] < 0.5).to(t.dtype), draw[1] * (2 * math.pi)


def grid_samples_reference(
    rays: Rays, t: Tensor, count: int = 6, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """`cone_samples` contracted and moved into the grid's cube: positions (R, N, count, 3) in [0, 1], std (R, N,
    count) in its units. The contracted ball of radius 2 lies in the cube [-2, 2]^3."""
    means, std = cone_samples(*rays, t, count, generator)
    return contract(means) * 0.25 + 0.5, contracted_std(means, std) * 0.25


def grid_samples(
    rays: Rays, t: Tensor, count: int = 6, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """`grid_samples_reference`, with the same random numbers, by the C++ kernel for float32 on the CPU where there is a
    compiler. No gradient."""
    with torch.no_grad():
        kernels = library("zipnerf/cone_samples") if t.dtype == torch.float32 and t.device.type == "cpu" else None
        if kernels is None:
            return grid_samples_reference(rays, t, count, generator)
        flip, turn = _spirals(t, generator)
        positions, std = t.new_empty((*flip.shape, count, 3)), t.new_empty((*flip.shape, count))
        inputs = [x.float().contiguous() for x in (
            rays.origins, rays.directions, rays.radii, t, flip, turn.cos(), turn.sin(), *_pattern(count),
        )]  # fmt: skip
        kernels.cone_samples(
            *(pointer(x) for x in (*inputs, positions, std)),
            ctypes.c_int64(len(t)), ctypes.c_int(flip.shape[1]), ctypes.c_int(count),
            ctypes.c_int(torch.get_num_threads()),
        )  # fmt: skip
        return positions, std
