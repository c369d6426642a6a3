"""Robust Zip-NeRF reconstruction of captured and generated views."""

from cat3d_core.zipnerf.config import PRESETS, ReconstructConfig
from cat3d_core.zipnerf.field import Field
from cat3d_core.zipnerf.points import PointCloud, point_cloud, surface_depth
from cat3d_core.zipnerf.render import Render, render_image, render_ladder
from cat3d_core.zipnerf.trainer import NonFiniteError, Trainer
from cat3d_core.zipnerf.views import Views

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
