"""3D Gaussian splatting: Gaussians as data, their rasteriser (torch reference, C++ kernels, gsplat), training by MCMC,
and splats of what another reconstruction renders."""

from cat3d_core.splats.config import PRESETS, REFINE, SplatConfig
from cat3d_core.splats.from_renders import from_renders
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import render
from cat3d_core.splats.reconstructor import Splats
from cat3d_core.splats.trainer import SplatTrainer, train

__all__ = [
    "PRESETS",
    "REFINE",
    "Gaussians",
    "SplatConfig",
    "SplatTrainer",
    "Splats",
    "from_renders",
    "render",
    "train",
]
