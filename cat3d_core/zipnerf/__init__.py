"""Robust Zip-NeRF reconstruction of captured and generated views."""

from cat3d_core.zipnerf.config import PRESETS, ZipNerfConfig
from cat3d_core.zipnerf.field import Field
from cat3d_core.zipnerf.reconstructor import ZipNerf
from cat3d_core.zipnerf.render import render_image, render_ladder
from cat3d_core.zipnerf.trainer import Trainer

__all__ = ["PRESETS", "Field", "Trainer", "ZipNerf", "ZipNerfConfig", "render_image", "render_ladder"]
