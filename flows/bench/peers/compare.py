"""The rows of `cat3d bench peers`: the same task for a process of ours and one of each peer's, one after the other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import cat3d_core
from cat3d_core.reconstruction import Views
from cat3d_core.zipnerf import PRESETS
from flows.bench import poses
from flows.bench.peers.task import Task, write_task
from flows.bench.reconstruct import procedural_views
from flows.bench.rows import MissingError, Row, marked, scenes_of
from flows.errors import InputError
from flows.jobs.request import Request, make_config
from flows.pipeline.runner import opened, run_missing

#: Where the peers are installed, unless this variable names another folder.
VARIABLE = "CAT3D_PEERS"
CHECKOUT = Path(cat3d_core.__file__).resolve().parents[1]
FAMILIES, VIEWS = ("dtu", "mip360", "llff", "re10k", "co3d"), (3, 9, 20)
OURS = ("tiny", "fast")
#: Rays of a step of nerfacto. Its own number is 4,096; on one core such a step takes 12 s and an eighth of it learns
#: as much in the same time (docs/log/2026-11-29_peers.md).
RAYS = 512


def rows(quick: bool, data: Path | None) -> list[Row]:
    """Every part. In full nerfacto trains for two minutes a scene; with `data` poses are compared too."""
    interpreter()
    threads = torch.get_num_threads()
    found = metric_rows(2 if quick else 4, 378, 504, 2 if quick else 5, threads)
    found += sampler_rows(8 if quick else 64, (8, 20) if quick else (8, 10, 20, 50), threads)
    found += network_rows(1 if quick else 4, 3 if quick else 10, threads)
    found += reading_rows(8 if quick else 24, 256 if quick else 512, 3, threads)
    if data is not None:
        scenes = scenes_of(data, ["strecha_fountain_P11"] if quick else list(poses.SCENES))
        found += pose_rows(scenes, 11 if quick else 20, threads)
    families, views, presets = (FAMILIES[:1], (9,), OURS[:1]) if quick else (FAMILIES, VIEWS, OURS)
    size, seconds = (32, 40.0) if quick else (64, 120.0)
    found += reconstruction_rows(families, views, size, seconds, presets, threads)
    return marked_ours(found)


def marked_ours(rows: list[Row]) -> list[Row]:
    """The rows with `default`: ours, of a reconstruction the end of the preset `fast`."""
    ours: Row = {"who": "cat3d"}
    end = ours | {"setting": "fast", "step": PRESETS["fast"].iterations}
    return [marked([row], end if row["part"] == "reconstruction" else ours)[0] for row in rows]


def interpreter() -> Path:
    """The Python of the peers' environment. Raises MissingError."""
    found = Path(os.environ.get(VARIABLE, CHECKOUT / ".venv-peers")) / "bin" / "python"
    if not found.exists():
        raise MissingError(f"{found} is not there: `make peers` installs the programs to compare with.")
    return found


def measure(python: Path | str, module: str, task: Task) -> list[Row]:
    """What `module` of this package measures in a process of that interpreter. Raises InputError with the end of what
    the process printed, where it fails."""
    with tempfile.TemporaryDirectory(prefix="cat3d-peer-") as name:
        folder = Path(name)
        write_task(folder, task)
        environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "OMP_NUM_THREADS": str(task.settings["threads"])}
        done = subprocess.run(
            [str(python), "-m", f"flows.bench.peers.{module}", name],
            env=environment, cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise InputError(f"{python} -m flows.bench.peers.{module} failed:\n{done.stderr[-2000:]}")
        rows: list[Row] = json.loads((folder / "rows.json").read_text(encoding="utf-8"))
        return rows


def reconstruction_task(family: str, views: int, size: int, **settings: Any) -> Task:
    """A procedural scene: `views` training views out of a capture of 24, 4 held out."""
    train, test, _ = procedural_views(family, views, 4, size, size)
    arrays = {}
    for role, found in (("train", train), ("test", test)):
        arrays[f"{role}_images"] = _stacked(found)
        arrays[f"{role}_intrinsics"] = found.cameras.intrinsics.numpy()
        arrays[f"{role}_cameras"] = found.cameras.world_from_camera.numpy()
    return Task(settings, arrays)


def _stacked(views: Views) -> np.ndarray:
    return np.stack([views.image(index).numpy() for index in range(len(views))])


def reconstruction_rows(
    families: Sequence[str], views: Sequence[int], size: int, seconds: float, presets: Sequence[str], threads: int
) -> Iterator[Row]:
    """PSNR against seconds of nerfacto and of our presets. `to_peer_psnr_seconds`: when ours was first as good as
    the best point of nerfacto's; null where it never was."""
    python = interpreter()
    for family in families:
        for count in views:
            common = {"part": "reconstruction", "scene": family, "views": count, "size": size, "threads": threads}
            task = reconstruction_task(family, count, size, seconds=seconds, seed=0, threads=threads)
            found = measure(python, "nerfacto", Task(task.settings | {"rays": RAYS}, task.arrays))
            theirs: list[Row] = [common | {"who": "nerfacto", "setting": f"{RAYS} rays a step"} | row for row in found]
            yield from theirs
            best = max(row["psnr_db"] for row in theirs)
            for preset in presets:
                ours = measure(sys.executable, "zipnerf", Task(task.settings | {"preset": preset}, task.arrays))
                good = [row["seconds"] for row in ours if row["psnr_db"] >= best]
                reached = {"to_peer_psnr_seconds": min(good, default=None)}
                yield from (common | {"who": "cat3d", "setting": preset} | row | reached for row in ours)


def sampler_rows(groups: int, steps: Sequence[int], threads: int) -> list[Row]:
    """diffusers' schedulers beside our solver."""
    task = Task({"groups": groups, "steps": list(steps), "threads": threads}, {})
    return [{"part": "sampler", "threads": threads} | row for row in measure(interpreter(), "schedulers", task)]


def metric_rows(views: int, height: int, width: int, repeats: int, threads: int) -> list[Row]:
    """scikit-image, torchmetrics and pytorch-msssim beside our metrics."""
    settings = {"views": views, "height": height, "width": width, "repeats": repeats, "threads": threads}
    found = measure(interpreter(), "packages", Task(settings, {}))
    return [{"part": "metrics", "threads": threads} | row for row in found]


def network_rows(groups: int, repeats: int, threads: int) -> list[Row]:
    """diffusers' U-Net beside ours."""
    task = Task({"groups": groups, "repeats": repeats, "threads": threads}, {})
    return [{"part": "network", "threads": threads} | row for row in measure(interpreter(), "networks", task)]


def pose_rows(scenes: Sequence[Path], views: int, threads: int) -> Iterator[Row]:
    """COLMAP's own steps beside our pose stage, which is built from them."""
    for scene in scenes:
        task = Task({"scene": str(scene.resolve()), "views": views, "threads": threads}, {})
        common = {"part": "poses", "scene": scene.name, "views": views, "threads": threads}
        yield from (common | row for row in measure(sys.executable, "mapper", task))


def reading_rows(views: int, size: int, repeats: int, threads: int) -> list[Row]:
    """xarray and zarr beside our reading of a store, which is made for it."""
    with tempfile.TemporaryDirectory(prefix="cat3d-store-") as name:
        source = f"procedural:dtu/3?views={views}&width={size}&height={size}"
        [job] = Request(source, Path(name), ("3",), make_config({}, None, ["method=zipnerf"])).jobs()
        with opened(job):
            run_missing(job, until="ingest")
        task = Task({"store": str(job.store_path), "repeats": repeats, "threads": threads}, {})
        return [{"part": "store", "threads": threads} | row for row in measure(sys.executable, "reading", task)]
