"""The ray tracer: exact visible surface, hard shadows, textures, haze and sky, for many scenes in one pass."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.synthetic import intersect
from cat3d_core.synthetic.scene import KINDS, Scene, slot_range
from cat3d_core.synthetic.textures import Pyramid, sample_pyramid, texture_pyramid

# Rays x objects traced at once: small enough for a CPU's cache, large enough to hide a GPU's launch times.
_CHUNK = {"cpu": 1 << 18, "cuda": 1 << 26}
_SHADOW_OFFSET = 2e-3


class Traced(NamedTuple):
    """image (N, 3, H, W) in [0, 1]; depth (N, H, W): z-depth at pixel centres, inf for the sky; normal (N, 3, H, W):
    unit world normals at pixel centres towards the camera's side, zero for the sky."""

    image: Tensor
    depth: Tensor
    normal: Tensor


class Hits(NamedTuple):
    """t (S, R), inf for none; slot (S, R): which object; point (S, R, 3); normal (S, R, 3) unit, world;
    local (S, R, 3): hit point in the object's frame times half_size; axis (S, R): dominant axis of the normal there."""

    t: Tensor
    slot: Tensor
    point: Tensor
    normal: Tensor
    local: Tensor
    axis: Tensor


_SHAPES = {"room": intersect.room, "sphere": intersect.sphere, "box": intersect.box, "cylinder": intersect.cylinder}


def _unit(vectors: Tensor) -> Tensor:
    return vectors / intersect.length(vectors)[..., None].clamp(min=1e-12)


def used_slots(scene: Scene) -> dict[str, slice]:
    """Per kind the slots that some scene of the batch uses (a kind's objects fill its slots from the front)."""
    used = {}
    for kind in KINDS:
        slots = slot_range(kind)
        count = int(scene.active[:, slots].sum(-1).max())
        used[kind] = slice(slots.start, slots.start + count)
    return used


def _distances(scene: Scene, used: dict[str, slice], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """t of the nearest object among `used` along each ray, and its slot: (S, R) twice; inf and any slot for none."""
    best = torch.full(origins.shape[:2], math.inf, device=origins.device, dtype=origins.dtype)
    slot = torch.zeros_like(best, dtype=torch.long)
    origins, directions = origins.mT.contiguous(), directions.mT.contiguous()
    for kind, slots in used.items():
        count = slots.stop - slots.start
        if count == 0:
            continue
        if kind == "ground":
            t = intersect.ground(scene.waves, scene.flat_radius, origins, directions)[:, None]
        else:
            maps = scene.object_from_world[:, slots]
            linear = maps[..., :3].reshape(len(scene), count * 3, 3)
            offset = maps[..., 3].reshape(len(scene), count * 3, 1)
            local_origin = torch.baddbmm(offset, linear, origins).view(len(scene), count, 3, -1)
            local_direction = torch.bmm(linear, directions).view(len(scene), count, 3, -1)
            t = _SHAPES[kind](local_origin, local_direction)
        t = t.masked_fill(~scene.active[:, slots, None], math.inf)
        t, index = t.min(1)
        nearer = t < best
        best, slot = torch.where(nearer, t, best), torch.where(nearer, index + slots.start, slot)
    return best, slot


def closest_hits(scene: Scene, origins: Tensor, directions: Tensor, used: dict[str, slice] | None = None) -> Hits:
    """The first surface along each ray. origins, directions (S, R, 3) in the world; `used` as `used_slots` gives."""
    t, slot = _distances(scene, used or used_slots(scene), origins, directions)
    safe_t = torch.where(t.isfinite(), t, torch.zeros_like(t))[..., None]
    point = origins + safe_t * directions
    row = slot[..., None] + torch.arange(len(scene), device=slot.device)[:, None, None] * scene.active.shape[1]
    maps = scene.object_from_world.flatten(0, 1)[row[..., 0]]
    local = (maps[..., :3] @ point[..., None])[..., 0] + maps[..., 3]
    size = scene.half_size.flatten(0, 1)[row[..., 0]]

    dominant = local.abs().argmax(-1)
    face = torch.zeros_like(local).scatter_(-1, dominant[..., None], 1.0) * local.sign()
    radial = intersect.length(local[..., :2])
    on_cap = local[..., 2].abs() > radial
    side = torch.cat([local[..., :2], torch.zeros_like(local[..., :1])], -1)
    cap = torch.zeros_like(local)
    cap[..., 2] = local[..., 2].sign()

    def is_kind(kind: str) -> Tensor:
        slots = slot_range(kind)
        return ((slot >= slots.start) & (slot < slots.stop))[..., None]

    normal = torch.where(is_kind("sphere"), local, face)
    normal = torch.where(is_kind("cylinder"), torch.where(on_cap[..., None], cap, side), normal)
    normal = torch.where(is_kind("room"), -face, normal)
    world_normal = (maps[..., :3].mT @ normal[..., None])[..., 0]
    grounded = is_kind("ground")
    gradient = intersect.ground_gradient(scene.waves, scene.flat_radius, point[..., :2].mT)
    uphill = torch.cat([-gradient.mT, torch.ones_like(gradient.mT[..., :1])], -1)
    world_normal = torch.where(grounded, uphill, world_normal)
    world_normal = _unit(world_normal)
    axis = torch.where(grounded[..., 0], torch.full_like(dominant, 2), normal.abs().argmax(-1))
    local = torch.where(grounded, point, local * size)
    return Hits(t, slot, point, world_normal, local, axis)


def _visibility(scene: Scene, used: dict[str, slice], hits: Hits, to_light: Tensor) -> Tensor:
    """(S, R) 1 where the light is seen, 0 in the shadow of a solid (ground and room cast none)."""
    origin = hits.point + _SHADOW_OFFSET * hits.normal
    solids = {kind: slots for kind, slots in used.items() if kind not in ("ground", "room")}
    t, _ = _distances(scene, solids, origin, to_light)
    reach = torch.where(scene.light[:, 3:] > 0, torch.ones_like(t), torch.full_like(t, math.inf))
    return (t >= reach).to(t.dtype)


def _surface_colour(
    scene: Scene, used: dict[str, slice], pyramid: Pyramid, hits: Hits, directions: Tensor, radius: Tensor
) -> Tensor:
    """(S, R, 3) light leaving the surfaces towards the camera. radius (S, R): ray footprint at t = 1."""
    batch = torch.arange(len(scene), device=hits.t.device)[:, None]
    u = torch.where(hits.axis == 0, hits.local[..., 1], hits.local[..., 0])
    v = torch.where(hits.axis == 2, hits.local[..., 1], -hits.local[..., 2])
    repeats = scene.texture_scale[batch, hits.slot]
    view = _unit(-directions)
    facing = (hits.normal * view).sum(-1).abs().clamp(min=0.1)
    t = torch.where(hits.t.isfinite(), hits.t, torch.zeros_like(hits.t))
    footprint = 2 * radius * t * repeats / facing.sqrt()
    which = batch * scene.textures.shape[1] + scene.texture[batch, hits.slot]
    texel = sample_pyramid(pyramid, which, torch.stack([u, v], -1) * repeats[..., None], footprint)
    albedo = (scene.bias[batch, hits.slot] + scene.tint[batch, hits.slot] * texel).clamp(0, 1)

    light = scene.light[:, None]
    to_light = light[..., :3] - light[..., 3:] * hits.point
    distance = intersect.length(to_light)[..., None].clamp(min=1e-6)
    toward = to_light / distance
    lambert = (hits.normal * toward).sum(-1, keepdim=True).clamp(min=0)
    seen = _visibility(scene, used, hits, to_light)[..., None]
    falloff = torch.where(light[..., 3:] > 0, 1.5 / (0.5 + 0.3 * distance.square()), torch.ones_like(distance))
    half = _unit(toward + view)
    highlight = (hits.normal * half).sum(-1, keepdim=True).clamp(min=0) ** 40
    hemisphere = 0.7 + 0.3 * hits.normal[..., 2:]
    diffuse = albedo * (scene.ambient[:, None] * hemisphere + scene.light_colour[:, None] * lambert * seen * falloff)
    return diffuse + scene.gloss[batch, hits.slot][..., None] * highlight * seen * (lambert > 0)


def _sky_colour(scene: Scene, pyramid: Pyramid, directions: Tensor, radius: Tensor) -> Tensor:
    """(S, R, 3) background along each direction."""
    unit = _unit(directions)
    elevation = unit[..., 2]
    zenith, horizon = scene.sky[:, None, 0], scene.sky[:, None, 1]
    gradient = horizon + (zenith - horizon) * elevation.clamp(min=0).sqrt()[..., None]
    slot, weight, repeats = (p[:, None] for p in scene.panorama.unbind(-1))
    # An even number of mirrored repeats closes the circle without a seam.
    u = (torch.atan2(unit[..., 1], unit[..., 0]) / (2 * math.pi)) * 2 * repeats
    v = 0.5 - torch.asin(elevation.clamp(-1, 1)) * 2 * repeats / (2 * math.pi)
    batch = torch.arange(len(scene), device=unit.device)[:, None]
    which = (batch * scene.textures.shape[1] + slot.long()).expand_as(u)
    footprint = radius / intersect.length(directions) * repeats / math.pi * 2
    panorama = sample_pyramid(pyramid, which, torch.stack([u, v], -1), footprint)
    return gradient + (panorama - gradient) * weight[..., None]


def trace_rays(scene: Scene, origins: Tensor, directions: Tensor, radii: Tensor) -> Tensor:
    """(S, R, 3) colours in [0, 1]. origins, directions (S, R, 3) in the world, radii (S, R): footprint at t = 1."""
    pyramid = texture_pyramid(scene.textures)
    used = used_slots(scene)
    step = _chunk_rays(scene, used)
    out = []
    for o, d, r in zip(origins.split(step, 1), directions.split(step, 1), radii.split(step, 1), strict=True):
        hits = closest_hits(scene, o, d, used)
        surface = _surface_colour(scene, used, pyramid, hits, d, r)
        sky = _sky_colour(scene, pyramid, d, r)
        distance = (hits.t * intersect.length(d)).clamp(max=1e6)[..., None]
        haze = 1 - torch.exp(-distance / scene.haze_distance[:, None, None])
        surface = surface + (scene.sky[:, None, 2] - surface) * haze
        out.append(torch.where(hits.t.isfinite()[..., None], surface, sky).clamp(0, 1))
    return torch.cat(out, 1)


def _chunk_rays(scene: Scene, used: dict[str, slice]) -> int:
    objects = sum(slots.stop - slots.start for slots in used.values())
    return max(1, _CHUNK.get(scene.active.device.type, _CHUNK["cpu"]) // (len(scene) * max(objects, 8)))


def render_views(scene: Scene, cameras: Cameras, supersample: int = 2) -> Tensor:
    """Images of many scenes at once: cameras (S * V) of one size, scene by scene -> (S, V, 3, H, W) in [0, 1].

    Raises ValueError when the cameras differ in size or don't divide by the scenes.
    """
    width, height = _common_size(cameras)
    if len(cameras) % len(scene):
        raise ValueError(f"{len(cameras)} cameras don't divide evenly over {len(scene)} scenes.")
    views = len(cameras) // len(scene)
    fine_w, fine_h = width * supersample, height * supersample
    rays = _grid_rays(cameras.resize(fine_w, fine_h), fine_w, fine_h)
    origins, directions, radii = (r.reshape(len(scene), views * fine_h * fine_w, *r.shape[2:]) for r in rays)
    colour = trace_rays(scene, origins, directions, radii)
    fine = colour.reshape(-1, fine_h, fine_w, 3).permute(0, 3, 1, 2)
    image = torch.nn.functional.avg_pool2d(fine, supersample)
    return image.reshape(len(scene), views, 3, height, width)


def trace(scene: Scene, cameras: Cameras, view_index: int | None = None, supersample: int = 2) -> Traced:
    """Image, z-depth and normals of one scene in one view or (view_index None) in all views, all of one size.

    Colours average supersample^2 rays a pixel; depth and normal belong to the pixel's centre, where they are exact.
    Raises ValueError for a batch of several scenes (use `render_views`) or cameras of several sizes.
    """
    if len(scene) != 1:
        raise ValueError(f"trace takes one scene, and this batch holds {len(scene)}; index it first.")
    device = scene.active.device
    chosen = (cameras if view_index is None else cameras[view_index]).to(device, torch.float32)
    width, height = _common_size(chosen)
    image = render_views(scene, chosen, supersample)[0]
    depths, normals = [], []
    rays = _grid_rays(chosen, width, height)
    used = used_slots(scene)
    step = _chunk_rays(scene, used)
    for o, d in zip(rays[0].reshape(1, -1, 3).split(step, 1), rays[1].reshape(1, -1, 3).split(step, 1), strict=True):
        hits = closest_hits(scene, o, d, used)
        depths.append(hits.t[0])
        normals.append(torch.where(hits.t[0].isfinite()[:, None], hits.normal[0], 0.0))
    depth = torch.cat(depths).reshape(-1, height, width)
    return Traced(image, depth, torch.cat(normals).reshape(-1, height, width, 3).permute(0, 3, 1, 2))


def _common_size(cameras: Cameras) -> tuple[int, int]:
    if len(cameras) == 0 or bool((cameras.size != cameras.size[0]).any()):
        raise ValueError("The tracer takes one or more cameras of one image size; split the batch by size first.")
    width, height = cameras.size[0].tolist()
    return width, height


def _grid_rays(cameras: Cameras, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rays through all pixel centres of all cameras: origins, directions (N, H * W, 3), radii (N, H * W).

    The same rays as `rays.pixel_rays` gives, a camera at a time instead of a pixel at a time.
    """
    device, dtype = cameras.intrinsics.device, cameras.intrinsics.dtype
    y, x = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")
    grid = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)]).double().reshape(3, -1)
    inverse_k = torch.linalg.inv(cameras.intrinsics.double())
    directions = (cameras.rotation.double() @ inverse_k @ grid).mT.to(dtype)
    radii = inverse_k[:, :, :2].norm(dim=1).mean(-1, keepdim=True).to(dtype) / 12**0.5
    return cameras.centers[:, None].expand_as(directions), directions, radii.expand(directions.shape[:2])
