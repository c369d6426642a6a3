"""Camera trajectories: the scene's frame, the curves, the paper's recipes, the automatic choice, free space."""

from cat3d_core.trajectories.automatic import choose_recipe
from cat3d_core.trajectories.frame import SceneFrame, estimate_up, look_at, scene_frame
from cat3d_core.trajectories.free_space import FreeSpace
from cat3d_core.trajectories.paths import Shift
from cat3d_core.trajectories.recipes import RECIPES, Recipe, build_trajectory

__all__ = [
    "RECIPES",
    "FreeSpace",
    "Recipe",
    "SceneFrame",
    "Shift",
    "build_trajectory",
    "choose_recipe",
    "estimate_up",
    "look_at",
    "scene_frame",
]
