"""Generators: what makes views of a scene from given ones, whichever network is behind it."""

from cat3d_core.generation.cat3d import Cat3dGenerator, cat3d_spec
from cat3d_core.generation.generate import generate
from cat3d_core.generation.memory import MemoryTooSmall
from cat3d_core.generation.protocol import Cost, Generator, GeneratorSpec, ViewGroup

__all__ = [
    "Cat3dGenerator",
    "Cost",
    "Generator",
    "GeneratorSpec",
    "MemoryTooSmall",
    "ViewGroup",
    "cat3d_spec",
    "generate",
]
