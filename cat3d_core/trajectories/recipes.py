"""The paper's trajectories by name, with its counts, and how a recipe becomes poses.

The paper (appendix 'Details of Generating Novel Views') gives the kind of path and the number of views: single image
80 (spiral or orbit), RealEstate10K 800, LLFF 960, DTU 480, CO3D 640, mip-NeRF 360 720. All are multiples of the 80
views of its single orbit (figure 'ablation'), so a path here has 80 views. The scales and shifts are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.trajectories import paths
from cat3d_core.trajectories.frame import SceneFrame, look_at
from cat3d_core.trajectories.free_space import FreeSpace
from cat3d_core.trajectories.paths import Shift

VIEWS_PER_PATH = 80
# With fewer views than 80 a path there are fewer paths rather than paths of a handful of views.
MIN_VIEWS_PER_PATH = 20
_STRENGTHS = (1.0, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True)
class Recipe:
    """A family of paths: one curve, every combination of its scales and shifts.

    curve(frame, captured, n, shift) -> poses (n, 4, 4). round_the_scene: views look in from around a centre, else
    they look one way. from_inputs: fitted to the input views, where the others are fitted to all views that are known
    (paper: 'all views in the training set'). looks_at_center: every view's forward axis goes through the scene's
    centre. sides, heights and forwards are in units of the scene's distance.
    """

    name: str
    curve: Callable[[SceneFrame, Cameras, int, Shift], Tensor]
    description: str
    scales: tuple[float, ...] = (1.0,)
    sides: tuple[float, ...] = (0.0,)
    heights: tuple[float, ...] = (0.0,)
    forwards: tuple[float, ...] = (0.0,)
    round_the_scene: bool = False
    looks_at_center: bool = True
    from_inputs: bool = False

    @property
    def shifts(self) -> list[Shift]:
        """One shift per path: scales outermost, then sides, heights, forwards."""
        return [Shift(*s) for s in product(self.scales, self.sides, self.heights, self.forwards)]

    def with_shifts(
        self,
        scales: Sequence[float] | None = None,
        sides: Sequence[float] | None = None,
        heights: Sequence[float] | None = None,
        forwards: Sequence[float] | None = None,
    ) -> Recipe:
        """This recipe with other scales and shifts; None keeps its own. Raises ValueError for an empty list or a
        scale that is not positive."""
        given = (scales, sides, heights, forwards)
        own = (self.scales, self.sides, self.heights, self.forwards)
        new = [tuple(g) if g is not None else o for g, o in zip(given, own, strict=True)]
        if not all(new) or min(new[0]) <= 0:
            raise ValueError(
                f"The trajectory {self.name} needs a scale, side, height and forward shift at least, and scales above "
                f"0; got scales {new[0]}, sides {new[1]}, heights {new[2]}, forwards {new[3]}."
            )
        return replace(self, scales=new[0], sides=new[1], heights=new[2], forwards=new[3])

    @property
    def count(self) -> int:
        """Views by default: 80 a path."""
        return VIEWS_PER_PATH * len(self.shifts)


RECIPES: dict[str, Recipe] = {
    r.name: r
    for r in (
        Recipe("single_spiral", paths.spiral, "spiral on a cylinder, into and out of the scene"),
        Recipe("single_orbit", paths.orbit, "one orbit round the object", round_the_scene=True),
        Recipe(
            "realestate10k",
            paths.spline,
            "spline through the input views, shifted sideways and ahead",
            sides=(-0.2, -0.1, 0.0, 0.1, 0.2),
            forwards=(-0.1, 0.1),
            looks_at_center=False,
            from_inputs=True,
        ),
        Recipe(
            "llff",
            paths.forward_circle,
            "forward-facing circles, scaled and shifted along the viewing axis",
            scales=(0.3, 0.6, 0.9, 1.2),
            forwards=(-0.1, 0.0, 0.1),
        ),
        Recipe(
            "dtu",
            paths.forward_circle,
            "forward-facing circles, scaled and shifted along the viewing axis",
            scales=(0.4, 0.7, 1.0),
            forwards=(-0.1, 0.1),
        ),
        Recipe(
            "co3d",
            paths.spline_around,
            "spline through the input views, scaled about the object",
            scales=(0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4),
            round_the_scene=True,
            looks_at_center=False,
            from_inputs=True,
        ),
        Recipe(
            "mipnerf360",
            paths.ellipse,
            "ellipses round the scene, scaled and shifted in height",
            scales=(0.75, 0.9, 1.05),
            heights=(-0.15, 0.0, 0.15),
            round_the_scene=True,
        ),
    )
}


def views_of_paths(paths_wanted: int, count: int) -> list[int]:
    """How many views each path gets, 0 for paths left out; sums to count.

    Enough views: shared evenly. Fewer than MIN_VIEWS_PER_PATH a path: that many views on evenly chosen paths, so that
    a small plan has paths of the same shape.
    """
    if count < 1:
        raise ValueError(f"A plan needs at least one view; {count} were asked for.")
    used = max(1, min(paths_wanted, count // MIN_VIEWS_PER_PATH))
    chosen = [(2 * i + 1) * paths_wanted // (2 * used) for i in range(used)]
    views = [0] * paths_wanted
    for rank, path in enumerate(chosen):
        views[path] = count // used + (1 if rank < count % used else 0)
    return views


def build_trajectory(
    recipe: Recipe, frame: SceneFrame, captured: Cameras, free: FreeSpace, count: int | None = None
) -> tuple[Tensor, Tensor, list[str]]:
    """Poses (N, 4, 4) of all views of a recipe, the path number (N,) of each, and what had to be changed, in sentences.

    A path with a blocked or unusually placed camera is drawn back towards the fitted path, in quarters of its scale
    and shift; cameras that are still blocked then move towards the nearest captured one.
    """
    shifts = recipe.shifts
    amounts = views_of_paths(len(shifts), recipe.count if count is None else count)
    all_poses, numbers, softened, moved = [], [], [], 0
    for number, (shift, n) in enumerate(zip(shifts, amounts, strict=True)):
        if n == 0:
            continue
        strength, path, blocked = _softened(recipe, frame, captured, free, n, shift)
        if strength < 1:
            softened.append(f"{number} (to {strength:.0%})")
        if blocked.any():
            moved += int(blocked.sum())
            path = _retreated(recipe, frame, free, path)
        all_poses.append(path)
        numbers += [number] * n
    reasons = []
    if softened:
        reasons.append(
            "Scale and shift of these paths were reduced, since cameras came too near the surface, too far in, or to "
            f"elevations the captured views don't have: {', '.join(softened)}."
        )
    if moved:
        reasons.append(
            f"{moved} cameras were still in or too near the geometry and moved towards the nearest captured camera."
        )
    return torch.cat(all_poses), torch.tensor(numbers), reasons


def _softened(
    recipe: Recipe, frame: SceneFrame, captured: Cameras, free: FreeSpace, n: int, shift: Shift
) -> tuple[float, Tensor, Tensor]:
    """The largest strength of the shift with the fewest offending cameras, its path, and which of it are blocked."""
    best: tuple[float, Tensor, Tensor] | None = None
    fewest = n + 1
    for strength in _STRENGTHS:
        path = recipe.curve(frame, captured, n, shift.softened(strength))
        centers = path[:, :3, 3]
        blocked = free.blocked(centers)
        faults = int((blocked | free.unusual(centers, recipe.round_the_scene)).sum())
        if faults < fewest:
            fewest, best = faults, (strength, path, blocked)
        if faults == 0 or shift == Shift():
            break
    assert best is not None
    return best


def _retreated(recipe: Recipe, frame: SceneFrame, free: FreeSpace, path: Tensor) -> Tensor:
    centers = free.retreat(path[:, :3, 3])
    changed = (centers != path[:, :3, 3]).any(-1)
    out = path.clone()
    out[:, :3, 3] = centers
    if recipe.looks_at_center and changed.any():
        # The images' own up: what the rest of the path uses, without asking which that was.
        for i in torch.nonzero(changed)[:, 0].tolist():
            up = -path[i, :3, 1]
            out[i] = look_at(centers[i : i + 1], frame.center, up, path[i, :3, 0])[0]
    return out
