"""The rooms of the house keep their import rules (ARCHITECTURE.md)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STDLIB = sys.stdlib_module_names
ALLOWED = {
    "cat3d_core": {"torch", "numpy", "safetensors", "triton", "gsplat", "cat3d_core"},  # triton, gsplat: guarded, GPU only
    "schemas": {"zarr", "numcodecs", "pyarrow", "pydantic", "yaml", "numpy", "schemas"},
}


def imported_packages(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names - set(STDLIB)


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_room_imports_only_what_it_may(room: str) -> None:
    wrong = {
        str(path.relative_to(ROOT)): sorted(extra)
        for path in (ROOT / room).rglob("*.py")
        if (extra := imported_packages(path) - ALLOWED[room])
    }
    assert not wrong, f"{room} may import only {sorted(ALLOWED[room])} and the standard library: {wrong}"


def test_core_imports_with_only_torch_numpy_and_safetensors() -> None:
    """Import every core module in a process where the other packages can't be found."""
    modules = sorted(
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in (ROOT / "cat3d_core").rglob("*.py")
        if "triton" not in path.name
    )
    blocked = ["prefect", "zarr", "pyarrow", "pydantic", "open3d", "pycolmap", "OpenImageIO", "rich", "typer", "yaml"]
    code = (
        f"import sys, importlib\nfor name in {blocked!r}: sys.modules[name] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_training_needs_none_of_the_packages_that_a_borrowed_gpu_lacks() -> None:
    """What infra/gpu/lease.sh runs there, with the packages it carries (docs/guides/training.md)."""
    blocked = ["prefect", "zarr", "numcodecs", "open3d", "pycolmap", "imageio_ffmpeg", "fastapi", "jinja2"]
    modules = ["flows.cli", "flows.errors", "flows.commands.train", "flows.bench.model", "flows.bench.reconstruct"]
    code = (
        f"import sys, importlib\nfor name in {blocked!r}: sys.modules[name] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_only_test_and_bench_setup_names_the_shared_folder() -> None:
    named = [
        str(path.relative_to(ROOT))
        for room in ("cat3d_core", "schemas", "flows")
        for path in (ROOT / room).rglob("*.py")
        if "../shared" in path.read_text() or "/work/shared" in path.read_text()
    ]
    assert not named, f"Only test and benchmark set-up may know where the shared data lie: {named}"
