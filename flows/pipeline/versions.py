"""Which versions made a result."""

from __future__ import annotations

import importlib.metadata
import platform

import cat3d_core

PACKAGES = ("torch", "numpy", "zarr", "prefect", "pyarrow", "pycolmap", "OpenImageIO", "open3d-cpu")


def provenance() -> dict[str, str]:
    """Versions of cat3d, Python and the packages that do the work, for a store's attributes and the report."""
    out = {"cat3d": cat3d_core.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "not installed"
    return out
