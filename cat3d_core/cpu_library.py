"""Small C++ kernels: compiled by g++ on first use, cached by source and processor, called through ctypes."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import subprocess
import tempfile
import warnings
from pathlib import Path

from torch import Tensor

_FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-shared", "-fPIC", "-std=c++17")


def _processor() -> str:
    """What -march=native depends on, so that a cache on a shared disk serves unlike machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    except OSError:
        return platform.processor()


def cache_folder() -> Path:
    """Where compiled kernels are kept: $CAT3D_CACHE, the home's .cache/cat3d, or where there is no home that can be
    written (containers) a folder of this user's in the temporary directory. Raises OSError where none can be had."""
    if given := os.environ.get("CAT3D_CACHE"):
        return Path(given)
    try:
        folder = Path.home() / ".cache" / "cat3d"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except (RuntimeError, OSError):
        pass
    folder = Path(tempfile.gettempdir()) / f"cat3d-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():  # somebody else's: no code is loaded from there
        raise OSError(f"{folder} belongs to another user; name a folder in CAT3D_CACHE")
    return folder


def _compile(name: str) -> Path:
    """Path of the shared library of this package's NAME.cpp (such as zipnerf/hash_grid) for this processor, compiled
    where the cache lacks it."""
    source = Path(__file__).parent / f"{name}.cpp"
    compiler = os.environ.get("CXX", "g++")
    key = hashlib.sha256(source.read_bytes() + repr((compiler, _FLAGS, _processor())).encode()).hexdigest()[:24]
    folder = cache_folder()
    library = folder / f"{source.stem}-{key}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            built = Path(scratch) / library.name
            subprocess.run(
                [compiler, *_FLAGS, str(source), "-o", str(built)], check=True, capture_output=True, text=True
            )
            os.replace(built, library)  # atomic: another process sees all of it or nothing
    return library


@functools.cache
def _load(name: str) -> ctypes.CDLL | str:
    try:
        return ctypes.CDLL(str(_compile(name)))
    except (OSError, subprocess.CalledProcessError) as error:
        return str(getattr(error, "stderr", None) or error)


@functools.cache
def _warn(problem: str) -> None:
    warnings.warn(
        f"The CPU kernels could not be compiled, so the plain torch reference runs (over 10x slower): {problem}. "
        "Install g++ with OpenMP, or name a compiler in CXX.",
        stacklevel=3,
    )


def library(name: str) -> ctypes.CDLL | None:
    """The kernels of the core's NAME.cpp, such as "zipnerf/hash_grid"; compiles them at the first call.

    None where that fails, with one warning.
    """
    found = _load(name)
    if isinstance(found, str):
        _warn(found)
        return None
    return found


def pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    """The address of a contiguous tensor's data; null for None."""
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())
