"""Cameras, rays and raymaps."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.coverage import bin_of
from cat3d_core.diffusion.conditioning import camera_vectors, view_matrices
from cat3d_core.rays import pixel_rays, raymap, reference_from_image
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import ROUNDING, Call, Exact, Reference, Routine, each, zero

_SIZE = 64  # pixels a side of the cameras drawn here


def _intrinsics(draw: Draw) -> Tensor:
    """(count, 3, 3): focal lengths from a thousandth of to a thousand times the image, any principal point, skew."""
    focal = draw.log_between(2, 1e-3 * _SIZE, 1e3 * _SIZE)
    middle = draw.signed(2, 1e-6, 1e4)
    k = torch.zeros(draw.count, 3, 3, dtype=torch.float64)
    k[:, 0, 0], k[:, 1, 1], k[:, 2, 2] = focal[:, 0], focal[:, 1], 1
    k[:, :2, 2], k[:, 0, 1] = middle, draw.between(1, -0.1, 0.1)[:, 0] * focal[:, 0]
    return k


def pose_of(rotation: Tensor, center: Tensor) -> Tensor:
    pose = torch.eye(4, dtype=rotation.dtype).repeat(*rotation.shape[:-2], 1, 1)
    pose[..., :3, :3], pose[..., :3, 3] = rotation, center
    return pose


def cameras_of(k: Tensor, pose: Tensor) -> Cameras:
    return Cameras(k, pose, torch.full((len(k), 2), _SIZE))


def length(x: Tensor) -> Tensor:
    """Euclidean length over the last axis without overflow or underflow."""
    largest = x.abs().amax(-1, keepdim=True)
    return (largest * (x / torch.where(largest > 0, largest, 1.0)).norm(dim=-1, keepdim=True))[..., 0]


def _project_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return _intrinsics(draw), pose_of(draw.rotation()[:, 0], draw.signed(3)), draw.signed(3)


def _project(k: Tensor, pose: Tensor, point: Tensor) -> Tensor:
    pixels, depth = cameras_of(k, pose).project(point)
    each_own = torch.arange(len(k))
    return torch.cat([pixels[each_own, each_own], depth[each_own, each_own, None]], -1)


def _project_reference(k: Tensor, pose: Tensor, point: Tensor) -> Exact:
    camera = ((point - pose[:, :3, 3])[:, :, None] * pose[:, :3, :3]).sum(1)  # R^T (p - c)
    depth = camera[:, 2]
    homogeneous = (k * camera[:, None]).sum(-1)
    pixels = homogeneous[:, :2] / depth[:, None]
    reach = length(point) + length(pose[:, :3, 3])
    # A point's rounding moves its pixel by focal / depth; the depth's own by as much times the pixel's tangent.
    spread = reach * (k[:, :2].abs().sum(-1).T + pixels.T.abs()) / depth
    meant = depth > 1e-5 * reach
    scale = torch.stack([*torch.where(meant, spread, torch.inf), reach], -1)
    return Exact(torch.cat([torch.where(meant[:, None], pixels, 0.0), depth[:, None]], -1), scale)


def _inverse(pose: Tensor) -> Tensor:
    return cameras_of(torch.eye(3, dtype=pose.dtype).expand(len(pose), 3, 3), pose).camera_from_world


def _inverse_reference(pose: Tensor) -> Exact:
    """A general inverse; rounding leaves a pose rigid to eps only, which moves the centre by as much of itself."""
    scale = torch.ones_like(pose)
    scale[:, :3, 3] = length(pose[:, :3, 3])[:, None]
    return Exact(torch.linalg.inv(pose), scale)


def _window_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """Camera, image point, window (left, top, width, height) and its size after resampling, whole numbers."""
    window = torch.cat([draw.between(2, -5000, 5000), draw.between(2, 1, 5000)], 1).round().long()
    return _intrinsics(draw), draw.between(2, -10, _SIZE + 10), window, draw.between(2, 1, 5000).round().long()


def _window(k: Tensor, xy: Tensor, window: Tensor, size: Tensor) -> Tensor:
    """Direction of the same ray by way of the cropped, padded and resampled camera."""
    left, top, width, height = window.tolist()
    camera = cameras_of(k[None], torch.eye(4, dtype=k.dtype)[None]).crop(left, top, width, height)
    camera = camera.pad(3, 4, 5, 6).resize(*size.tolist())
    factor = size.to(k) / torch.tensor([width + 8, height + 10]).to(k)
    moved = (xy - window[:2].to(k) + torch.tensor([3.0, 4.0]).to(k)) * factor
    return pixel_rays(camera, torch.zeros(1, dtype=torch.long), moved[None]).directions[0]


def _window_reference(k: Tensor, xy: Tensor, window: Tensor, size: Tensor) -> Exact:
    v = (xy[:, 1] - k[:, 1, 2]) / k[:, 1, 1]
    u = (xy[:, 0] - k[:, 0, 2] - k[:, 0, 1] * v) / k[:, 0, 0]
    away = (xy.abs() + k[:, :2, 2].abs() + window[:, :2].abs() + 10).sum(-1)
    skew = 1 + (k[:, 0, 1] / k[:, 0, 0]).abs()
    reach = 1 + skew * away * (1 / k[:, 0, 0] + 1 / k[:, 1, 1])
    return Exact(torch.stack([u, v, torch.ones_like(u)], -1), reach[:, None])


def _bins(directions: Tensor) -> Tensor:
    """How far a direction lies outside the band of height and the sector of azimuth that it was sorted into."""
    number = bin_of(directions)
    wide = directions.double()
    height, turn = wide[:, 2] / length(wide), torch.atan2(wide[:, 1], wide[:, 0]) / torch.pi
    outside = torch.zeros_like(height)
    for value, index, count in ((height, number // 16, 8), (turn, number % 16, 16)):
        low = 2 * index / count - 1
        outside = torch.maximum(outside, torch.maximum(low - value, value - low - 2 / count))
    return outside.to(directions.dtype)


def _ray_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return _intrinsics(draw), draw.rotation()[:, 0], draw.between(2, -10, _SIZE + 10)


def _rays(k: Tensor, rotation: Tensor, xy: Tensor) -> Tensor:
    rays = pixel_rays(cameras_of(k, pose_of(rotation, xy.new_zeros(3))), torch.arange(len(k)), xy)
    return torch.cat([rays.directions, rays.radii], -1)


def _rays_reference(k: Tensor, rotation: Tensor, xy: Tensor) -> Exact:
    """By solving K d = (x, y, 1) backwards, one row after the other."""

    def back(x: Tensor, y: Tensor) -> Tensor:
        v = (y - k[:, 1, 2]) / k[:, 1, 1]
        u = (x - k[:, 0, 2] - k[:, 0, 1] * v) / k[:, 0, 0]
        return torch.stack([u, v, torch.ones_like(u)], -1)

    x, y = xy.unbind(-1)
    directions = torch.einsum("nij,nj->ni", rotation, back(x, y))
    column_x = 1 / k[:, 0, 0]
    column_y = torch.hypot(k[:, 0, 1] / (k[:, 0, 0] * k[:, 1, 1]), 1 / k[:, 1, 1])
    radius = (column_x + column_y) / 2 * 2 / 12**0.5
    v = (y.abs() + k[:, 1, 2].abs()) / k[:, 1, 1]
    reach = 1 + v + (x.abs() + k[:, 0, 2].abs() + k[:, 0, 1].abs() * v) / k[:, 0, 0]
    return Exact(torch.cat([directions, radius[:, None]], -1), torch.stack([reach, reach, reach, radius], -1))


def _raymap_inputs(draw: Draw) -> tuple[Tensor, ...]:
    return (
        _intrinsics(draw),
        pose_of(draw.rotation()[:, 0], draw.signed(3)),
        pose_of(draw.rotation()[:, 0], draw.signed(3)),
    )


def _raymap(plucker: bool) -> Call:
    def one(k: Tensor, pose: Tensor, reference: Tensor) -> Tensor:
        return raymap(cameras_of(k[None], pose[None]), reference, 2, 3, plucker)[0]

    return each(one)


def _raymap_reference(plucker: bool) -> Reference:
    x, y = (torch.arange(3).double() + 0.5) * _SIZE / 3, (torch.arange(2).double() + 0.5) * _SIZE / 2
    grid = torch.stack([x.expand(2, 3), y[:, None].expand(2, 3)])

    def exact(k: Tensor, pose: Tensor, reference: Tensor) -> Exact:
        to_reference = reference[:, :3, :3].transpose(1, 2)
        v = (grid[1] - k[:, 1, 2, None, None]) / k[:, 1, 1, None, None]
        u = (grid[0] - k[:, 0, 2, None, None] - k[:, 0, 1, None, None] * v) / k[:, 0, 0, None, None]
        local = torch.stack([u, v, torch.ones_like(u)], 1)
        turned = torch.einsum("nij,njk,nkhw->nihw", to_reference, pose[:, :3, :3], local)
        directions = turned / length(turned.movedim(1, -1))[:, None]
        offset = (pose[:, :3, 3] - reference[:, :3, 3])[:, None]
        origins = (offset @ reference[:, :3, :3])[:, 0, :, None, None].expand_as(directions)
        reach = length(pose[:, :3, 3]) + length(reference[:, :3, 3])
        if plucker:
            ox, oy, oz = origins.unbind(1)
            dx, dy, dz = directions.unbind(1)
            origins = torch.stack([oy * dz - oz * dy, oz * dx - ox * dz, ox * dy - oy * dx], 1)
        scale = torch.cat([reach[:, None].expand(-1, 3), torch.ones(len(k), 3)], 1)
        # A principal point far outside the image cancels in K^-1 before the direction is normalised.
        cancel = 1 + (k[:, :2, 2].abs() + _SIZE).amax(1) / k[:, 0, 0].minimum(k[:, 1, 1])
        return Exact(torch.cat([origins, directions], 1), (scale * cancel[:, None])[:, :, None, None])

    return exact


def _vector_inputs(draw: Draw) -> tuple[Tensor, ...]:
    focal = draw.log_between(1, 0.2, 20.0)  # in image widths
    k = torch.zeros(draw.count, 3, 3, dtype=torch.float64)
    k[:, 0, 0] = k[:, 1, 1] = focal[:, 0] * _SIZE
    k[:, :2, 2], k[:, 2, 2] = _SIZE / 2, 1
    return k, draw.rotation()[:, 0], draw.signed(3, 1e-6, 1e6)


def _vector(k: Tensor, rotation: Tensor, center: Tensor) -> Tensor:
    """Position and focal length, and the rotation that the quaternion stands for."""
    matrices = reference_from_image(cameras_of(k, pose_of(rotation, center)), torch.eye(4, dtype=k.dtype))
    vector = camera_vectors(matrices.to(k.dtype))
    q = vector[:, 3:7]
    w, xyz = q[:, :1, None], q[:, 1:]
    zero_ = torch.zeros_like(q[:, 0])
    x, y, z = xyz.unbind(-1)
    skew = torch.stack([zero_, -z, y, z, zero_, -x, -y, x, zero_], -1).view(-1, 3, 3)
    turned = torch.eye(3, dtype=k.dtype) + 2 * w * skew + 2 * skew @ skew
    return torch.cat([vector[:, :3], vector[:, 7:], turned.flatten(1)], -1)


def _vector_reference(k: Tensor, rotation: Tensor, center: Tensor) -> Exact:
    focal = k[:, :1, 0] / _SIZE
    scale = torch.cat([length(center)[:, None].expand(-1, 3), focal, torch.ones(len(k), 9)], -1)
    return Exact(torch.cat([center, focal, rotation.flatten(1)], -1), scale)


def _matrix_inputs(draw: Draw) -> tuple[Tensor, ...]:
    """A lens, a pose, and a point given by its place in the image (u, v in [-1, 1]) and its depth."""
    k, rotation, center = _vector_inputs(draw)
    return k, rotation, center, torch.cat([draw.between(2, -1.0, 1.0), draw.log_between(1, 1e-3, 1e3)], -1)


def _matrices(k: Tensor, rotation: Tensor, center: Tensor, place: Tensor) -> Tensor:
    """The point in the world, and back in the image."""
    matrices = reference_from_image(cameras_of(k, pose_of(rotation, center)), torch.eye(4, dtype=k.dtype))
    there, back = view_matrices(matrices)
    depth = place[:, 2:].double()
    image = torch.cat([place[:, :2].double() * depth, depth, torch.ones_like(depth)], -1)[..., None]
    world = back @ image
    return torch.cat([world[:, :3, 0], (there @ world)[:, :3, 0]], -1).to(k.dtype)


def _matrices_reference(k: Tensor, rotation: Tensor, center: Tensor, place: Tensor) -> Exact:
    depth, focal = place[:, 2:], k[:, :1, 0] / _SIZE
    local = torch.cat([place[:, :2] * depth / (2 * focal), depth], -1)
    world = (rotation * local[:, None]).sum(-1) + center
    # Of a far centre the point's own place is rounded away; a long lens enlarges what is left.
    reach = (length(local) + length(center))[:, None]
    scale = torch.cat([reach.expand(-1, 3), (reach * (1 + 2 * focal)).expand(-1, 3)], -1)
    return Exact(torch.cat([world, place[:, :2] * depth, depth], -1), scale)


ROUTINES = [
    Routine(
        "cameras.project", "pixels and depth; finite behind and at the camera",
        _project_inputs, _project, _project_reference, ROUNDING, chunk=128, share=0.5,
    ),
    Routine(
        "cameras.camera_from_world", "inverse of rigid poses",
        lambda draw: (pose_of(draw.rotation()[:, 0], draw.signed(3)),), _inverse, _inverse_reference,
        {torch.float64: 1e-14, torch.float32: 2e-6},
    ),
    Routine(
        "cameras.crop", "crop, pad and resize leave every ray where it was", _window_inputs, each(_window),
        _window_reference, ROUNDING, share=0.1,
    ),
    Routine(
        "coverage.bin_of", "the bin of a direction of any length",
        lambda draw: (draw.direction()[:, 0] * draw.log_between(1, 1e-12, 1e12),), _bins, zero, ROUNDING,
    ),
    Routine(
        "rays.pixel_rays", "directions and cone radii for any lens", _ray_inputs, _rays, _rays_reference,
        ROUNDING,
    ),
    Routine(
        "rays.raymap", "origin and unit direction relative to a pose, worked in float64",
        _raymap_inputs, _raymap(False), _raymap_reference(False), ROUNDING, share=0.1,
    ),
    Routine(
        "rays.raymap[plucker]", "moment and unit direction relative to a pose",
        _raymap_inputs, _raymap(True), _raymap_reference(True), ROUNDING, share=0.1,
    ),
    Routine(
        "conditioning.view_matrices", "a point of the image into the world, and back, worked in float64",
        _matrix_inputs, _matrices, _matrices_reference, ROUNDING,
    ),
    Routine(
        "conditioning.camera_vectors", "position, rotation and focal length read off a matrix",
        _vector_inputs, _vector, _vector_reference, ROUNDING,
    ),
]  # fmt: skip
