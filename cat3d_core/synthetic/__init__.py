"""Procedural scenes and their ray tracer: training set, benchmark, and ground truth for geometry."""

from cat3d_core.synthetic.capture import look_at, random_cameras
from cat3d_core.synthetic.families import FAMILIES, random_scene
from cat3d_core.synthetic.scene import Scene
from cat3d_core.synthetic.tracer import Traced, render_views, trace

__all__ = ["FAMILIES", "Scene", "Traced", "look_at", "random_cameras", "random_scene", "render_views", "trace"]
