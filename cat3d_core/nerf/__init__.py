"""Robust Zip-NeRF reconstruction of captured and generated views."""

from cat3d_core.nerf.config import PRESETS, ReconstructConfig
from cat3d_core.nerf.field import Field
from cat3d_core.nerf.points import PointCloud, point_cloud, surface_depth
from cat3d_core.nerf.render import Render, render_image, render_ladder
from cat3d_core.nerf.trainer import NonFiniteError, Trainer
from cat3d_core.nerf.views import Views

__all__ = [
    "PRESETS",
    "Field",
    "NonFiniteError",
    "PointCloud",
    "ReconstructConfig",
    "Render",
    "Trainer",
    "Views",
    "point_cloud",
    "render_image",
    "render_ladder",
    "surface_depth",
]
