"""Whether cat3d's dependencies have wheels for other systems than this one: `python infra/check_platforms.py`.

pip evaluates markers for the system it runs on, whatever `--platform` says, so they are evaluated here for each target
and pip is asked for what remains, one dry run for each system and version of Python. Dependencies of dependencies are
not looked at for the same reason. Asks the package index; installs nothing. Exit code 1 where something is missing that
is not known to be (`LACKING`). The result is in docs/reference/platforms.md.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

_LINUX = [f"manylinux_2_{minor}" for minor in (39, 35, 34, 31, 28, 27, 17)] + ["manylinux2014"]
#: System: its markers, and the platform tags of wheels that it takes.
TARGETS = {
    "Linux x86": ({"sys_platform": "linux", "platform_machine": "x86_64"}, [f"{tag}_x86_64" for tag in _LINUX]),
    "Linux ARM": ({"sys_platform": "linux", "platform_machine": "aarch64"}, [f"{tag}_aarch64" for tag in _LINUX]),
    "macOS ARM": (
        {"sys_platform": "darwin", "platform_machine": "arm64"},
        [f"macosx_{version}_0_{kind}" for version in (15, 14, 13, 12, 11) for kind in ("arm64", "universal2")],
    ),
    "macOS x86": (
        {"sys_platform": "darwin", "platform_machine": "x86_64"},
        [
            f"macosx_{version}_{kind}"
            for version in ("14_0", "13_0", "12_0", "11_0", "10_15", "10_13", "10_9")
            for kind in ("x86_64", "universal2")
        ],
    ),  # fmt: skip
    "Windows": ({"sys_platform": "win32", "platform_machine": "AMD64"}, ["win_amd64"]),
}
VERSIONS = ("3.11", "3.12")
#: System: what it lacks, for a reason that nothing here can change.
LACKING = {"macOS x86": "torch"}  # PyTorch has made none for Intel Macs since 2.3


def missing(requirements: list[str], tags: list[str], python: str) -> str | None:
    """What pip says of wheels that it doesn't find; None where all are there."""
    with tempfile.TemporaryDirectory() as folder:
        platforms = [argument for tag in tags for argument in ("--platform", tag)]
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps", "--target", folder]
        command += ["--only-binary=:all:", "--python-version", python, "--implementation", "cp", *platforms]
        done = subprocess.run([*command, *requirements], capture_output=True, text=True)
    said = [line.removeprefix("ERROR: ") for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    return None if done.returncode == 0 else next(iter(said), done.stderr)


def main() -> int:
    document = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    declared = [Requirement(text) for text in document["project"]["dependencies"]]
    faults = 0
    for name, (markers, tags) in TARGETS.items():
        wanted = [f"{r.name}{r.specifier}" for r in declared if r.marker is None or r.marker.evaluate(markers)]
        for python in VERSIONS:
            said = missing(wanted, tags, python)
            faults += said is not None and f"install {LACKING.get(name)}" not in said
            print(f"{name}, Python {python}: {said or f'wheels for all {len(wanted)} dependencies'}", flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
