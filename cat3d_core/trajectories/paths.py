"""The curves cameras move along: ellipses (orbits and forward-facing circles), splines, spirals.

Every function returns poses (n, 4, 4), float64, OpenCV axes, `world_from_camera`, evenly spaced along the curve, and
moves with the world: it only uses the frame and the cameras handed in. Shifts are in units of the scene's distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.splines import even_parameters, rotation_angle, rotation_spline, shortest_order, vector_spline
from cat3d_core.trajectories.frame import SceneFrame, look_at, poses
from cat3d_core.view_selection import farthest_points, pose_distance

# Dense captures are thinned to this many knots: a spline through every frame of a hand-held video shakes with it.
MAX_KNOTS = 12
_DENSE = 48  # curve samples per knot interval when measuring arc length; closed curves have 16 times as many


@dataclass(frozen=True)
class Shift:
    """How one path of a family differs from the fitted one: scaled about its centre (or the scene's), then moved.

    scale 1 and zeros is the fitted path. side, up, forward: along the frame's right, up and viewing axes, in units of
    the scene's distance.
    """

    scale: float = 1.0
    side: float = 0.0
    up: float = 0.0
    forward: float = 0.0

    def softened(self, strength: float) -> Shift:
        """The shift between the fitted path (strength 0) and this one (strength 1)."""
        return Shift(1 + (self.scale - 1) * strength, self.side * strength, self.up * strength, self.forward * strength)


def orbit(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Level circle once round the centre, from the first camera's azimuth, at the cameras' mean height and radius."""
    x, y, height, radius = _level_positions(frame, cameras)
    start = torch.atan2(y[0], x[0])
    angle = start + _turn(n)
    circle = torch.stack([radius * angle.cos(), radius * angle.sin(), angle * 0], -1) * shift.scale
    return _look_in(frame, circle + circle.new_tensor([0, 0, float(height) + shift.up]), shift)


def ellipse(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Level ellipse round the centre fitted to the cameras (paper, mip-NeRF 360 trajectories), equal arc steps.

    The conic x^T Q x = 1 fitted by least squares to the level positions (in units of their mean radius), drawn to the
    circle Q = I with the weight of half a camera, so that what few cameras or an arc leave open becomes a circle.
    """
    x, y, height, radius = _level_positions(frame, cameras)
    u, v = x / radius, y / radius
    # Unknowns q = (Q11, Q22, sqrt(2) Q12): the Frobenius norm of Q is then the plain norm of q.
    rows = torch.stack([u * u, v * v, 2**0.5 * u * v], -1) / len(u) ** 0.5
    prior = (0.5 / len(u)) ** 0.5 * torch.eye(3, dtype=u.dtype)
    target = torch.cat([torch.full_like(u, len(u) ** -0.5), prior @ prior.new_tensor([1, 1, 0])])
    q = torch.linalg.lstsq(torch.cat([rows, prior]), target[:, None]).solution[:, 0]

    def at(angle: Tensor) -> Tensor:
        c, s = angle.cos(), angle.sin()
        inverse_square = q[0] * c * c + q[1] * s * s + 2**0.5 * q[2] * c * s
        r = radius * inverse_square.clamp(1 / 1.6**2, 1 / 0.6**2).rsqrt()  # a wild fit stays near the circle
        return torch.stack([r * c, r * s, 0 * c], -1)

    start = torch.atan2(y[0], x[0])
    dense = start + torch.linspace(0, 2 * torch.pi, 16 * _DENSE + 1, dtype=x.dtype)
    angle = even_parameters(at(dense).diff(dim=0).norm(dim=-1), dense, n, closed=True)
    return _look_in(frame, at(angle) * shift.scale + x.new_tensor([0, 0, float(height) + shift.up]), shift)


def forward_circle(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Circle (ellipse) across the viewing direction, round the cameras' mean position, looking at the scene's centre.

    Half axes: the 90% quantiles of the cameras' offsets sideways and upwards, at least 5% of the scene's distance
    (paper: 'forward-facing circle path fitted from all views', LLFF and DTU).
    """
    middle = cameras.centers.mean(0)
    side, top = _image_axes(frame)
    offset = cameras.centers - middle
    floor = 0.05 * frame.distance
    half = [torch.quantile((offset @ axis).abs(), 0.9).clamp(min=floor) for axis in (side, top)]
    angle = _turn(16 * _DENSE + 1, closed=False)

    def at(angle: Tensor) -> Tensor:
        return half[0] * angle.cos()[:, None] * side + half[1] * angle.sin()[:, None] * top

    angle = even_parameters(at(angle).diff(dim=0).norm(dim=-1), angle, n, closed=True)
    centers = middle + shift.scale * at(angle) + frame.distance * _world_shift(frame, shift, side, top, frame.forward)
    return look_at(centers, frame.center, _path_up(frame, centers, top), side)


def spiral(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Single image: three turns on a cylinder round the viewing axis while moving into the scene, out, and back.

    Cylinder half axes 0.2 (sideways) and 0.12 (up, since floors are near) of the distance; 0.25 in and out, less where
    the nearest surface is near. Looks at the scene's centre throughout.
    """
    side, top = _image_axes(frame)
    t = torch.linspace(0, 1, 16 * _DENSE + 1, dtype=torch.float64)
    deep = min(0.25, 0.5 * frame.near / frame.distance)

    def at(t: Tensor) -> Tensor:
        # The eighth of a turn keeps the way in and the way out on different strands of the cylinder.
        turn, wave = 2 * torch.pi * (3 * t[:, None] + 1 / 8), (2 * torch.pi * t[:, None]).sin()
        across = 0.2 * turn.cos() * side + 0.12 * turn.sin() * top
        return frame.distance * (shift.scale * across + deep * wave * frame.forward)

    t = even_parameters(at(t).diff(dim=0).norm(dim=-1), t, n, closed=True)
    moved = frame.distance * _world_shift(frame, shift, side, top, frame.forward)
    centers = cameras.centers.mean(0) + at(t) + moved
    return look_at(centers, frame.center, _path_up(frame, centers, top), side)


def spline(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Spline through the captured views, moved sideways, up and horizontally ahead (paper, RealEstate10K). `scale`
    scales it about its own middle. One camera, or coincident ones, give the path's shifts only."""
    knots, times = _spline_knots(frame, cameras)
    moved = frame.distance * _world_shift(frame, shift, frame.right, frame.up, frame.ahead)
    middle = cameras.centers.mean(0)
    if len(knots) == 1:
        return poses(knots.rotation.expand(n, 3, 3), (knots.centers + moved).expand(n, 3))

    def at(t: Tensor) -> tuple[Tensor, Tensor]:
        return vector_spline(times, knots.centers, t), rotation_spline(times, knots.rotation, t)

    centers, rotations = at(_even_times(frame, at, times, n))
    return poses(rotations, middle + shift.scale * (centers - middle) + moved)


def spline_around(frame: SceneFrame, cameras: Cameras, n: int, shift: Shift) -> Tensor:
    """Spline through views that look at a common centre, scaled about that centre (paper, CO3D).

    Interpolates the direction from the centre on SO(3), the distance (its logarithm), and how the view differs from
    looking at the centre. So it goes round the object, never through it: two views 180 degrees apart at one height
    give a half circle at that height.
    """
    knots, times = _spline_knots(frame, cameras)
    moved = frame.distance * _world_shift(frame, shift, frame.right, frame.up, frame.ahead)
    facing = look_at(knots.centers, frame.center, frame.up, frame.right)[:, :3, :3]
    aside = facing.transpose(1, 2) @ knots.rotation
    radius = (knots.centers - frame.center).norm(dim=-1, keepdim=True).clamp(min=1e-3 * frame.distance)

    def place(facing: Tensor, radius: Tensor) -> Tensor:
        return frame.center - radius * facing[:, :, 2]

    if len(knots) == 1:
        start = frame.center + shift.scale * (place(facing, radius) - frame.center)
        return poses(knots.rotation.expand(n, 3, 3), (start + moved).expand(n, 3))

    def at(t: Tensor) -> tuple[Tensor, Tensor]:
        turned = rotation_spline(times, facing, t)
        distance = vector_spline(times, radius.log().expand(-1, 3), t)[:, :1].exp()
        return place(turned, distance), turned @ rotation_spline(times, aside, t)

    centers, rotations = at(_even_times(frame, at, times, n))
    return poses(rotations, frame.center + shift.scale * (centers - frame.center) + moved)


def _turn(n: int, closed: bool = True) -> Tensor:
    """n angles over one turn; closed leaves out the end, which is the start again."""
    return 2 * torch.pi * torch.arange(n, dtype=torch.float64) / (n if closed else max(n - 1, 1))


def _level_positions(frame: SceneFrame, cameras: Cameras) -> tuple[Tensor, Tensor, Tensor, float]:
    """Cameras about the centre in distance units: x (right), y (ahead), mean height, mean level radius (>= 0.3)."""
    x, y, z = frame.local(cameras.centers).unbind(-1)
    return x, y, z.mean(), max(float(torch.hypot(x, y).mean()), 0.3)


def _look_in(frame: SceneFrame, local: Tensor, shift: Shift) -> Tensor:
    """Poses at local (right, ahead, up) positions about the centre, looking at it."""
    local = local + local.new_tensor([shift.side, shift.forward, 0.0])
    centers = frame.center + frame.distance * local @ frame.axes
    return look_at(centers, frame.center, frame.up, frame.right)


def _image_axes(frame: SceneFrame) -> tuple[Tensor, Tensor]:
    """Unit sideways (horizontal) and upward axes across the mean viewing direction."""
    side = torch.linalg.cross(frame.forward, frame.up)
    side = side / side.norm() if side.norm() > 1e-3 else frame.right
    return side, torch.linalg.cross(side, frame.forward)


def _path_up(frame: SceneFrame, centers: Tensor, top: Tensor) -> Tensor:
    """The scene's up, or the images' up where a view comes within 15 degrees of the vertical (it would spin there)."""
    direction = frame.center - centers
    steep = (direction @ frame.up).abs() / direction.norm(dim=-1).clamp(min=1e-300)
    return top if bool((steep > 0.966).any()) else frame.up


def _world_shift(frame: SceneFrame, shift: Shift, side: Tensor, up: Tensor, forward: Tensor) -> Tensor:
    return shift.side * side + shift.up * up + shift.forward * forward


def _spline_knots(frame: SceneFrame, cameras: Cameras) -> tuple[Cameras, Tensor]:
    """Well spread captured views in travelling order, coincident ones merged, with centripetal knot times."""
    chosen = sorted(farthest_points(cameras, min(MAX_KNOTS, len(cameras)), frame.distance, direction_weight=0.5))
    far = pose_distance(cameras, cameras, frame.distance)
    kept: list[int] = []
    for i in chosen:
        if all(float(far[i, j]) > 1e-6 for j in kept):
            kept.append(i)
    knots = cameras[kept]
    # Knots in order of the trip; centripetal times (root of the distance) neither loop nor overshoot.
    distance = pose_distance(knots, knots, frame.distance)
    knots = knots[shortest_order(distance)]
    steps = pose_distance(knots, knots, frame.distance).diagonal(1).sqrt()
    return knots, torch.cat([steps.new_zeros(1), steps.cumsum(0)])


def _even_times(frame: SceneFrame, at, times: Tensor, n: int) -> Tensor:  # type: ignore[no-untyped-def]
    """Times of n views with equal steps in position (over the scene's distance) and rotation (radians) together."""
    dense = torch.cat(
        [torch.linspace(float(a), float(b), _DENSE + 1, dtype=times.dtype)[:-1] for a, b in zip(times, times[1:])]
        + [times[-1:]]
    )
    centers, rotations = at(dense)
    step = torch.hypot(centers.diff(dim=0).norm(dim=-1) / frame.distance, rotation_angle(rotations[:-1], rotations[1:]))
    return even_parameters(step, dense, n)
