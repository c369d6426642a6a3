"""Random captures of procedural scenes: cameras as each family's photographers place them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.random import generator
from cat3d_core.synthetic.intersect import ground_height
from cat3d_core.synthetic.scene import Scene, slot_range
from cat3d_core.synthetic.tracer import closest_hits

# Focus and distance of the cameras where only a family, and no scene, is given.
_DEFAULT_FOCUS = {"llff": 0.3, "dtu": 0.2, "co3d": 0.3, "re10k": 0.9, "mip360": 0.25}
_DEFAULT_REACH = {"llff": 1.6, "dtu": 1.2, "co3d": 1.2, "re10k": 2.0, "mip360": 1.6}
_FOV_DEGREES = {"llff": (42, 55), "dtu": (36, 48), "co3d": (45, 60), "re10k": (60, 80), "mip360": (48, 65)}
# No surface comes nearer to a camera than this share of the scene's reach.
CLEARANCE = 0.08
_MAX_ROUNDS = 30


def look_at(centers: Tensor, targets: Tensor, roll: Tensor | None = None) -> Tensor:
    """(N, 4, 4) world_from_camera of cameras at `centers` (N, 3) looking at `targets` (N, 3), the image's up towards
    world +z; roll (N,) in radians turns the image about its axis."""
    forward = targets - centers
    forward = forward / forward.norm(dim=-1, keepdim=True)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=centers.dtype).expand_as(forward)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    down = torch.linalg.cross(forward, right)
    if roll is not None:
        c, s = roll.cos()[:, None], roll.sin()[:, None]
        right, down = c * right + s * down, c * down - s * right
    pose = torch.eye(4, dtype=centers.dtype).repeat(len(centers), 1, 1)
    pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2], pose[:, :3, 3] = right, down, forward, centers
    return pose


class _Draw:
    """Uniform float64 columns from one generator."""

    def __init__(self, source: torch.Generator) -> None:
        self.source = source

    def __call__(self, count: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=self.source, dtype=torch.float64)


def _around(focus: Tensor, azimuth: Tensor, elevation: Tensor, distance: Tensor) -> Tensor:
    flat = elevation.cos()
    return focus + distance[:, None] * torch.stack([azimuth.cos() * flat, azimuth.sin() * flat, elevation.sin()], -1)


@dataclass(frozen=True)
class _Style:
    """What all cameras of one capture share. Angles in radians; start, bend, end (3,): a walk's control points."""

    azimuth: float
    rise: float
    tilt: float
    sway: float
    yaw: float
    turn: float
    start: Tensor
    bend: Tensor
    end: Tensor


def _random_style(draw: _Draw, extent: Tensor) -> _Style:
    azimuth, rise, tilt, sway, yaw, turn, lean, reach = draw(8, 0, 1).tolist()
    yaw = 2 * math.pi * yaw
    ahead = torch.tensor([math.cos(yaw), math.sin(yaw), 0.0], dtype=torch.float64)
    aside = torch.tensor([-math.sin(yaw), math.cos(yaw), 0.0], dtype=torch.float64)
    room = extent[:2].min()
    # Walk mostly forward, from the wall behind towards the middle.
    drift = 0.5 * (lean - 0.5) * extent.min() * aside
    start = -0.75 * ahead * room + drift
    end = (-0.1 + 0.3 * reach) * ahead * room - drift
    return _Style(
        azimuth=2 * math.pi * azimuth, rise=-0.05 + 0.45 * rise, tilt=0.25 + 0.3 * tilt, sway=1.0 + float(sway > 0.5),
        yaw=yaw, turn=1.6 * (turn - 0.5), start=start, end=end,
        bend=0.5 * (start + end) + 0.25 * (sway - 0.5) * aside * room,
    )  # fmt: skip


def _place(
    family: str, focus: Tensor, reach: float, style: _Style, u: Tensor, draw: _Draw, spread: float
) -> tuple[Tensor, Tensor]:
    """Centres and targets (N, 3) at positions u (N,) in [0, 1] along the family's path."""
    count = len(u)
    jitter = torch.stack([draw(count, -1, 1) for _ in range(3)], -1)
    if family == "llff":
        angle, radius = draw(count, 0, 2 * math.pi), draw(count, 0, 1).sqrt() * 0.35 * reach * spread
        offset = torch.stack([radius * angle.cos(), 0.08 * reach * jitter[:, 1], 0.6 * radius * angle.sin()], -1)
        home = focus + reach * torch.tensor([0.0, -1.0, style.rise], dtype=torch.float64)
        return home + offset, focus + 0.06 * reach * jitter
    if family == "re10k":
        along = 0.5 + (u - 0.5) * min(spread, 1.5)
        # A gently bent walk (quadratic Bezier), looking ahead with slowly turning yaw.
        way = (1 - along)[:, None] ** 2 * style.start + (2 * along * (1 - along))[:, None] * style.bend
        way = way + along[:, None] ** 2 * style.end + 0.02 * jitter
        heading = style.yaw + style.turn * (along - 0.5) + 0.08 * spread * jitter[:, 0]
        ahead = torch.stack([heading.cos(), heading.sin(), -0.08 + 0.05 * jitter[:, 2]], -1)
        return focus + way, focus + way + ahead
    if family == "dtu":
        azimuth = style.azimuth + draw(count, -1, 1) * math.radians(50) * spread
        middle = math.radians(38)
        elevation = middle + (draw(count, math.radians(15), math.radians(62)) - middle) * min(spread, 1.0)
        return _around(focus, azimuth, elevation, reach * (1 + 0.06 * jitter[:, 0])), focus + 0.03 * reach * jitter
    turn = style.azimuth + 2 * math.pi * (u - 0.5) * min(spread, 1.0)
    low, high = (0.2, 0.75) if family == "co3d" else (0.15, 0.7)
    swing = style.tilt + 0.18 * torch.sin(turn * style.sway) + 0.08 * jitter[:, 1]
    distance = reach * (1 + 0.12 * jitter[:, 0])
    return _around(focus, turn, swing.clamp(low, high), distance), focus + 0.05 * reach * jitter


def random_cameras(scene: Scene | str, seed: int, count: int, width: int, height: int, spread: float = 1.0) -> Cameras:
    """`count` cameras of one capture, in order along the family's path, float64.

    scene: one scene, or a family's name (then nothing is known to avoid). spread scales the range of positions:
    1 is the family's usual capture, smaller values keep the cameras near one another.
    With a scene, no camera stands inside an object, below ground or closer than CLEARANCE * reach to a surface, and
    every camera sees surfaces in at least a third of a coarse grid of its pixels.
    Raises ValueError for an unknown family, several scenes, or where no such cameras are found.
    """
    if isinstance(scene, Scene) and len(scene) != 1:
        raise ValueError(f"random_cameras takes one scene, and this batch holds {len(scene)}; index it first.")
    family = scene if isinstance(scene, str) else scene.families[0]
    if family not in _FOV_DEGREES:
        raise ValueError(f"There is no scene family '{family}'; the families are {', '.join(_FOV_DEGREES)}.")
    draw = _Draw(generator(seed, "synthetic cameras", family))
    if isinstance(scene, Scene):
        focus, reach = scene.focus[0].double().cpu(), float(scene.reach[0])
        extent = scene.half_size[0, slot_range("room").start].double().cpu()
    else:
        focus, reach = torch.tensor([0.0, 0.0, _DEFAULT_FOCUS[family]], dtype=torch.float64), _DEFAULT_REACH[family]
        extent = torch.full((3,), reach, dtype=torch.float64)
    fov = math.radians(float(draw(1, *_FOV_DEGREES[family])))
    focal = 0.5 * max(width, height) / math.tan(fov / 2)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)

    kept: list[tuple[float, Tensor]] = []
    style = _random_style(draw, extent)
    for attempt in range(_MAX_ROUNDS):
        # A blocked capture (a walk that starts inside a cupboard) is drawn anew every few rounds.
        if attempt and attempt % 6 == 0:
            style, kept = _random_style(draw, extent), []
        u = (torch.arange(2 * count, dtype=torch.float64) + draw(2 * count, 0, 1)) / (2 * count)
        centers, targets = _place(family, focus, reach, style, u, draw, spread)
        poses = look_at(centers, targets, roll=draw(2 * count, -0.03, 0.03))
        size = torch.tensor([width, height]).expand(len(poses), 2)
        cameras = Cameras(intrinsics.expand(len(poses), 3, 3).clone(), poses, size.clone())
        usable = _usable(scene, cameras) if isinstance(scene, Scene) else torch.ones(len(poses), dtype=torch.bool)
        kept += [(float(u[i]), poses[i]) for i in torch.nonzero(usable)[:, 0].tolist()]
        if len(kept) >= count:
            break
    if len(kept) < count:
        raise ValueError(f"Only {len(kept)} of {count} cameras of a '{family}' scene stand free; try another seed.")
    chosen = sorted(torch.randperm(len(kept), generator=draw.source)[:count].tolist(), key=lambda i: kept[i][0])
    poses = torch.stack([kept[i][1] for i in chosen])
    return Cameras(intrinsics.repeat(count, 1, 1), poses, torch.tensor([width, height]).repeat(count, 1))


def _usable(scene: Scene, cameras: Cameras) -> Tensor:
    """(N,) bool: the camera stands outside solids, above ground, clear of surfaces, and sees enough of them."""
    device = scene.active.device
    coarse = 6
    k = cameras.resize(coarse, coarse).to(dtype=torch.float32).intrinsics[0]
    x = (torch.arange(coarse) + 0.5 - k[0, 2]) / k[0, 0]
    y = (torch.arange(coarse) + 0.5 - k[1, 2]) / k[1, 1]
    grid = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(coarse, coarse)], -1).reshape(-1, 3)
    directions = grid @ cameras.rotation.float().mT
    origins = cameras.centers.float()[:, None].expand_as(directions)
    hits = closest_hits(scene, origins.reshape(1, -1, 3).to(device), directions.reshape(1, -1, 3).to(device))
    t = hits.t.reshape(len(cameras), -1).cpu()
    local = (scene.object_from_world[0, :, None, :, :3] @ cameras.centers.float().to(device)[None, :, :, None])[
        ..., 0
    ] + scene.object_from_world[0, :, None, :, 3]
    margin = 1 + CLEARANCE * float(scene.reach[0]) / scene.half_size[0].amin(-1).clamp(min=0.05)
    inside = (local.abs().amax(-1) < margin[:, None]) & scene.active[0][:, None]
    solid = inside[slot_range("sphere").start :].any(0).cpu()
    room = slot_range("room").start
    outside_room = (~(local[room].abs() < 1).all(-1) & scene.active[0, room]).cpu()
    clearance = CLEARANCE * float(scene.reach[0])
    # Most of the view should reach past what stands right before the camera.
    free = (t > clearance).all(-1) & (t.clamp(max=1e6).median(-1).values > 0.45 * float(scene.reach[0]))
    centers = cameras.centers.float().to(device).T[None]
    height = ground_height(scene.waves, scene.flat_radius, centers[:, :2])
    grounded = scene.active[0, slot_range("ground").start]
    buried = (grounded & (centers[0, 2] < height[0] + clearance)).cpu()
    sees = t.isfinite().float().mean(-1) > 1 / 3
    return ~solid & ~outside_room & ~buried & free & sees
