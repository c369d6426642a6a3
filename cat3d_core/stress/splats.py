"""Splats: images of Gaussians, the kernels' values and gradients, MCMC's split, the contracted positions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.quaternions import rotation_matrices
from cat3d_core.splats import rasterize_cpu, reference
from cat3d_core.splats.density import split
from cat3d_core.splats.trainer import expand
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import DOUBLE, ROUNDING, SINGLE, Exact, Routine, each, zero

_SIDE = 12
_FOCAL = 10.0
_COUNT = 5
_DECIDED = 1e-5  # pixels nearer to a cut than this are left out: there rounding decides, and the result jumps


def _camera(dtype: torch.dtype) -> Cameras:
    half = _SIDE / 2
    k = torch.tensor([[[_FOCAL, 0.5, half], [0, 1.2 * _FOCAL, half - 1], [0, 0, 1]]], dtype=dtype)
    return Cameras(k, torch.eye(4, dtype=dtype)[None], torch.tensor([[_SIDE, _SIDE]]))


def _inputs(draw: Draw, count: int = _COUNT) -> tuple[Tensor, ...]:
    """Gaussians before the camera and beside its image, from a thousandth of a pixel to a hundred pixels wide, needles
    and sheets of 1 : 10^4 among them."""
    depth = draw.log_between(count, 0.02, 100.0)
    beside = draw.between(2 * count, -2.0, 2.0).view(-1, count, 2)
    means = torch.cat([beside * depth[..., None], depth[..., None]], -1)
    quaternions = draw.normal(4 * count).view(-1, count, 4)
    quaternions = torch.where(quaternions.norm(dim=-1, keepdim=True) > 1e-3, quaternions, 1.0)
    largest = draw.log_between(count, 1e-3, 100.0) / _FOCAL * depth
    thin = draw.log_between(2 * count, 1e-4, 1.0).view(-1, count, 2)
    scales = largest[..., None] * torch.cat([torch.ones_like(thin[..., :1]), thin], -1)
    return means, quaternions, scales, draw.between(count, 0.0, 1.0)


def _project(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor) -> Tensor:
    camera = _camera(means.dtype)
    flat = reference.project(
        means.flatten(0, 1), quaternions.flatten(0, 1), scales.flatten(0, 1), opacities.flatten(), camera
    )
    return torch.cat([flat.conic, flat.opacity[:, None]], 1).unflatten(0, means.shape[:2])


def _project_exact(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor) -> Exact:
    """The image's covariance as a product of whole matrices, its inverse as the adjugate over the determinant; what it
    covers without the blur from its singular values."""
    k, most = _camera(DOUBLE).intrinsics[0], reference.STEEPEST
    u = (means[..., 0] / means[..., 2]).clamp(-most, most)
    v = (means[..., 1] / means[..., 2]).clamp(-most, most)
    one, nil = torch.ones_like(u), torch.zeros_like(u)
    slope = torch.stack([one, nil, -u, nil, one, -v], -1).unflatten(-1, (2, 3)) / means[..., 2, None, None]
    image = k[:2, :2] @ slope @ rotation_matrices(quaternions) @ torch.diag_embed(scales)
    covariance = image @ image.mT + reference.BLUR * torch.eye(2, dtype=DOUBLE)
    xx, xy, yy = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    determinant = xx * yy - xy * xy
    sharp = torch.linalg.svdvals(image).prod(-1).square()
    ratio = (sharp / determinant).clamp_min(reference.LEAST_RATIO).sqrt()
    conic = torch.stack([yy, -xy, xx], -1) / determinant[..., None]
    scale = torch.cat([conic.abs().amax(-1, keepdim=True).expand(-1, -1, 3), one[..., None]], -1)
    return Exact(torch.cat([conic, (opacities * ratio)[..., None]], -1), scale)


def _colours(count: int, dtype: torch.dtype) -> Tensor:
    return torch.rand((count, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def _difference(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor) -> Tensor:
    """Largest differences between this machine's rasteriser and the reference in float64 from the same numbers: of the
    image, of the depth relative to the farthest, and of the gradients, relative to the largest."""
    draw = rasterize_cpu.rasterize if rasterize_cpu.available() else reference.rasterize
    inputs = means, quaternions, scales, opacities
    wide = [value.double().detach().requires_grad_() for value in inputs]
    given = [value.detach().requires_grad_() for value in inputs]
    colours, camera = _colours(len(means), DOUBLE), _camera(DOUBLE)
    with torch.enable_grad():
        composite = reference.composite(wide[0], wide[1], wide[2], wide[3], colours, camera)
        exact, margin = composite.raster, reference.margin(composite)
        narrow = colours.to(means), camera.to(dtype=means.dtype)
        found = draw(given[0], given[1], given[2], given[3], *narrow)
        decided = margin > _DECIDED
        ramp = torch.cos(torch.arange(_SIDE * _SIDE, dtype=DOUBLE)).view(_SIDE, _SIDE) * decided
        far = means[:, 2].double().amax()
        for raster, tensors in ((exact, wide), (found, given)):
            total = (raster.features.sum(0) * ramp).sum() + (raster.opacity * ramp).sum()
            total = total + (raster.depth * ramp).sum() / far
            for tensor, gradient in zip(tensors, torch.autograd.grad(total, tensors), strict=True):
                tensor.grad = gradient
    values = torch.cat([exact.features - found.features, (exact.opacity - found.opacity)[None]])
    depth = (exact.depth - found.depth).abs() / far
    errors = [((values.abs().amax(0) + depth) * decided).amax()]
    for a, b in zip(wide, given, strict=True):
        assert a.grad is not None
        assert b.grad is not None
        size = a.grad.abs().amax().clamp_min(1e-6 / a.detach().abs().amax().clamp_min(1e-6))
        errors.append((a.grad - b.grad.double()).abs().amax() / size)
    return torch.stack([errors[0], torch.stack(errors[1:]).amax()]).to(means.dtype)


def _split_inputs(draw: Draw) -> tuple[Tensor, ...]:
    opacity = draw.log_between(1, 1e-6, 1.0)[:, 0]
    near = 1 - draw.log_between(1, 1e-6, 1.0)[:, 0]
    return torch.where(draw.unit(1)[:, 0] < 0.5, opacity, near).clamp(1e-6, 1 - 1e-6), (
        draw.unit(1)[:, 0] * 10
    ).long() + 1


def _split(opacity: Tensor, copies: Tensor) -> Tensor:
    return torch.stack(split(opacity, copies), -1)


def _split_exact(opacity: Tensor, copies: Tensor) -> Exact:
    """MCMC eq. 9 as printed: a double sum of alternating binomials."""
    new = 1 - (1 - opacity).pow(1.0 / copies)
    total = torch.zeros_like(opacity)
    for i in range(1, int(copies.max()) + 1 if len(copies) else 1):
        for k in range(i):
            term = math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new.pow(k + 1)
            total = total + torch.where(i <= copies, term, 0.0)
    value = torch.stack([new, opacity / total], -1)
    # An opacity near 1 is rounded relative to what is missing to 1.
    return Exact(value, value * (1 + 1 / (1 - opacity)[:, None].sqrt()))


def _expand_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (draw.direction()[:, 0] * draw.between(1, 0.0, 1.998),)


def _expand_exact(contracted: Tensor) -> Exact:
    radius = contracted.norm(dim=-1, keepdim=True)
    value = torch.where(radius > 1, contracted / radius.clamp_min(1e-9) / (2 - radius), contracted)
    return Exact(value, value.norm(dim=-1, keepdim=True) / (2 - radius))


ROUTINES = [
    Routine(
        "splats.project", "images of 0.001 to 100 pixels, needles and sheets of 1 : 10^4 included",
        _inputs, _project, _project_exact, {SINGLE: 5e-5}, share=0.2,
    ),
    Routine(
        "splats.rasterize", "this machine's rasteriser: image and gradients as the reference's in float64",
        _inputs, each(_difference), zero, {SINGLE: 2e-3, DOUBLE: 1e-11}, share=0.01,
    ),
    Routine(
        "splats.split", "opacity and scale of up to 10 copies, for opacities of 1e-6 to 1 - 1e-6",
        _split_inputs, _split, _split_exact, {SINGLE: 4e-6},
    ),
    Routine(
        "splats.expand", "contracted positions back into space, up to a distance of 500",
        _expand_inputs, expand, _expand_exact, ROUNDING,
    ),
]  # fmt: skip
