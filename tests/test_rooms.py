"""Which package may import which (ARCHITECTURE.md), read from the source without running it."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STDLIB = sys.stdlib_module_names
ALLOWED = {
    "cat3d_core": {"torch", "numpy", "safetensors", "triton", "gsplat", "cat3d_core"},  # triton, gsplat: guarded
    "schemas": {"zarr", "numcodecs", "pyarrow", "pydantic", "yaml", "numpy", "schemas"},
}
PACKAGES = (*ALLOWED, "flows")
LONGEST_FILE = 300
#: Modules from a command down to the core, both counted, at most. At commit 0888913 it was 44: modules on a circle all
#: need each other, and with the stages that were imported by name one circle was 14 modules long.
LONGEST_CHAIN = 23


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


FILES = {module_name(path): path for package in PACKAGES for path in (ROOT / package).rglob("*.py")}


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Everything a file imports, wherever in it: modules, and names of packages that are modules."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = inner & set(FILES)
            names |= modules if modules == inner else modules | {node.module}
    return frozenset(names)


def ours(name: str) -> set[str]:
    """Modules of the project that a module of the project imports."""
    return {found for found in imports(FILES[name]) if found in FILES} - {name}


def package(name: str) -> str:
    """The folder of `flows`, or its module, or the whole package elsewhere."""
    parts = name.split(".")
    return ".".join(parts[:2]) if parts[0] == "flows" else parts[0]


@functools.cache
def depth(name: str) -> int:
    """Modules on the longest way from here into the core; 0 where none leads there."""
    if name.startswith("cat3d_core"):
        return 1
    deepest = max((depth(inner) for inner in ours(name)), default=0)
    return deepest + 1 if deepest else 0


def edges() -> dict[tuple[str, str], list[str]]:
    """Which package imports which, with the modules that do."""
    found: dict[tuple[str, str], list[str]] = {}
    for name in FILES:
        for inner in ours(name):
            if package(name) != package(inner):
                found.setdefault((package(name), package(inner)), []).append(f"{name} -> {inner}")
    return found


@pytest.mark.parametrize("name", sorted(ALLOWED))
def test_package_imports_only_what_it_may(name: str) -> None:
    wrong = {
        str(path.relative_to(ROOT)): sorted(extra)
        for path in (ROOT / name).rglob("*.py")
        if (extra := {found.split(".")[0] for found in imports(path)} - STDLIB - ALLOWED[name])
    }
    assert not wrong, f"{name} may import only {sorted(ALLOWED[name])} and the standard library: {wrong}"


def test_no_two_packages_import_each_other() -> None:
    found = edges()
    both = {pair: (found[pair], found[pair[::-1]]) for pair in found if pair[::-1] in found and pair[0] < pair[1]}
    assert not both, both


def test_no_file_leads_back_to_itself() -> None:
    after: dict[str, set[str]] = {name: ours(name) for name in FILES}
    while free := [name for name, inner in after.items() if not inner & set(after)]:
        for name in free:
            del after[name]
    leading = {name: sorted(inner & set(after)) for name, inner in after.items()}
    assert not leading, f"These files are on a circle of imports, or lead to one: {leading}"


def test_files_are_short_enough_to_be_read_at_once() -> None:
    long = {name: lines for name, path in FILES.items() if (lines := path.read_text().count("\n")) > LONGEST_FILE}
    assert not long, long


def test_the_way_from_a_command_to_the_core_stays_short() -> None:
    assert depth("flows.cli") <= LONGEST_CHAIN


def test_only_the_top_knows_the_stages() -> None:
    """Everything that a stage may use is written without the list of stages."""
    low = ("flows.jobs", "flows.generation", "flows.workers", "flows.media", "flows.readers", "flows.sfm")
    wrong = {pair: found for pair, found in edges().items() if pair[0] in low and pair[1] == "flows.stages"}
    assert not wrong, wrong


def test_library_code_does_not_live_in_benchmarks() -> None:
    infra = {str(path.relative_to(ROOT)): found for path in (ROOT / "infra").rglob("*.py")
             if (found := [name for name in imports(path) if name.startswith("flows.bench")])}  # fmt: skip
    assert not infra, infra
    users = {pair for pair in edges() if pair[1] == "flows.bench"}
    assert users == {("flows.commands", "flows.bench")}


def test_tests_mirror_flows() -> None:
    folders = {path.name for path in (ROOT / "flows").iterdir() if (path / "__init__.py").exists()}
    tests = {path.name for path in (ROOT / "tests" / "flows").iterdir() if path.is_dir()} - {"__pycache__"}
    assert tests <= folders, f"{sorted(tests - folders)} test a package that is not there"


@pytest.mark.parametrize(
    "words", ["--help", "run --help", "run", "nothing-of-ours", "train --nothing-of-ours", "bench --help"]
)
def test_help_and_wrong_usage_answer_before_anything_heavy_is_imported(words: str) -> None:
    code = (
        f"import sys\nsys.argv = ['cat3d', *{words.split()!r}]\nfrom flows.cli import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    code = stop.code\n"
        "print(code, sorted({'torch', 'prefect', 'zarr', 'pyarrow', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == f"{0 if '--help' in words else 2} []", done.stdout + done.stderr


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
    modules = [
        "flows.cli",
        "flows.errors",
        "flows.commands.train",
        "flows.training.evaluation",
        "flows.bench.reconstruct",
    ]
    code = (
        f"import sys, importlib\nfor name in {blocked!r}: sys.modules[name] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_only_test_and_bench_setup_names_the_shared_folder() -> None:
    named = [
        str(path.relative_to(ROOT))
        for path in FILES.values()
        if "../shared" in path.read_text() or "/work/shared" in path.read_text()
    ]
    assert not named, f"Only test and benchmark set-up may know where the shared data lie: {named}"
