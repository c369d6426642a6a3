"""What all ways of reconstructing a scene from posed views have in common."""

from cat3d_core.reconstruction.points import PointCloud, point_cloud, surface_depth
from cat3d_core.reconstruction.protocol import NonFiniteError, ReconstructionRequest, Reconstructor
from cat3d_core.reconstruction.render import Render, normals_from_depth
from cat3d_core.reconstruction.views import Batch, Views, draw_batch

__all__ = [
    "Batch",
    "NonFiniteError",
    "PointCloud",
    "Reconstructor",
    "Render",
    "ReconstructionRequest",
    "Views",
    "draw_batch",
    "normals_from_depth",
    "point_cloud",
    "surface_depth",
]
