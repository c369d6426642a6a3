"""Seconds and peak memory against the number of photos and their size: `cat3d run` on photos as phones make them, and
nerfacto begun on the same photos where the peers are installed.

The photos show a painted wall from an arc of cameras in front of it, exactly, so that thousands of them cost little:
what is measured does not depend on what they show.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from flows.bench.peers import compare
from flows.bench.peers.task import Task
from flows.bench.rows import MissingError
from flows.exports.dataset import write_transforms
from flows.media.images import write_jpeg
from schemas.tables import TIMINGS, read_rows

#: Photos have the shape 4 : 3; sides by millions of pixels.
SIZES = {1: (1152, 864), 4: (2320, 1740), 12: (4000, 3000)}
#: The wall is drawn at this share of the size and repeated, with grain on top as sensors have it.
COARSE = 4
FOCAL = 0.8
GRAIN = 4.0
#: More memory than this nerfacto is not given, so that a machine of 16 GB survives it.
PEER_GIGABYTES = 10.0


def phone_photos(folder: Path, count: int, width: int, height: int) -> None:
    """Write `count` JPEG photos and their transforms.json; width and height are multiples of COARSE."""
    rng = np.random.default_rng(0)
    wall = torch.zeros(1, 3, 1024, 1024)
    for side in (8, 32, 128, 512):
        noise = torch.from_numpy(rng.uniform(-1, 1, (1, 3, side, side)).astype(np.float32))
        wall += functional.interpolate(noise, 1024, mode="bicubic") * 0.25
    wall = (0.5 + 0.5 * wall).clamp(0, 1)
    grain = rng.normal(0, GRAIN, (height, width, 1)).astype(np.float32)
    cameras = _arc(count, width, height)
    (folder / "images").mkdir(parents=True)
    names = [f"images/IMG_{view:04d}.jpg" for view in range(count)]
    for view, name in enumerate(names):
        coarse = _seen(wall, cameras, view, width // COARSE, height // COARSE)
        photo = coarse.repeat(COARSE, 0).repeat(COARSE, 1) + np.roll(grain, (37 * view, 91 * view), (0, 1))
        write_jpeg(folder / name, np.clip(photo, 0, 255).astype(np.uint8), quality=85)
    write_transforms(folder, cameras, names, ["captured"] * count, list(names))


def size_rows(quick: bool, data: Path | None) -> list[dict[str, Any]]:
    """Whole runs; the largest, 1,000 photos of 12 megapixels, are 3 GB on disk for a while."""
    return rows((4,), (1, 4)) if quick else rows((10, 100, 1000), tuple(SIZES))


def rows(counts: Sequence[int], megapixels: Sequence[int], preset: str = "tiny") -> list[dict[str, Any]]:
    """A row for each number and size: seconds and peak memory (bytes of the largest process) of `cat3d run`, and of its
    stages those that took longest. With the peers a second one: seconds until nerfacto trains, and what it holds."""
    found = []
    for count in counts:
        for size in megapixels:
            with tempfile.TemporaryDirectory(prefix="cat3d-size-") as folder:
                phone_photos(Path(folder) / "photos", count, *SIZES[size])
                what = {"photos": count, "megapixels": size}
                found.append({"who": "cat3d", **what, "preset": preset, **run(Path(folder), preset)})
                found += [{"who": "nerfacto", **what, **row} for row in nerfacto(Path(folder) / "photos")]
    return found


def nerfacto(photos: Path) -> list[dict[str, Any]]:
    """nerfacto's first steps on a folder of photos, by nerfstudio's own reader; nothing without the peers."""
    try:
        python = compare.interpreter()
    except MissingError:
        return []
    settings = {"photos": str(photos), "rays": compare.RAYS, "steps": 2, "gigabytes": PEER_GIGABYTES}
    rows = compare.measure(python, "nerfacto_size", Task(settings | {"threads": torch.get_num_threads()}, {}))
    return [{"seconds": r.pop("load_seconds"), "peak_gb": r.pop("peak_mb") / 1e3, **r} for r in rows]


def run(folder: Path, preset: str) -> dict[str, Any]:
    """One `cat3d run` of folder/photos into folder/out, in a process of its own. Raises RuntimeError where it fails."""
    command = [sys.executable, "-m", "flows.cli", "run", str(folder / "photos"), "--preset", preset]
    command += ["--out", str(folder / "out"), "--set", "evaluate.lpips=false"]
    started, before = time.monotonic(), os.times()
    done = subprocess.run(command, capture_output=True, text=True)
    seconds, after = time.monotonic() - started, os.times()
    if done.returncode:
        raise RuntimeError(f"cat3d run failed: {done.stderr[-500:]}")
    stages = {row["stage"]: row for row in read_rows(folder / "out" / "timings", TIMINGS).to_pylist()}
    size = re.search(r"worked on at (\d+) x (\d+)", done.stdout)
    return {
        "worked_on": f"{size[1]}x{size[2]}" if size else "whole",
        "seconds": seconds,
        "cpu_seconds": after.children_user + after.children_system - before.children_user - before.children_system,
        "peak_gb": max(row["peak_memory_bytes"] for row in stages.values()) / 1e9,
        **{f"{name}_s": stages[name]["seconds"] for name in ("ingest", "reconstruct", "render")},
        **{f"{name}_gb": stages[name]["peak_memory_bytes"] / 1e9 for name in ("ingest", "reconstruct", "render")},
    }


def _arc(count: int, width: int, height: int) -> Cameras:
    """Cameras on an arc in front of the wall z = 0, looking at its middle; OpenCV axes, +y of the world up."""
    poses = torch.zeros(count, 4, 4, dtype=torch.float64)
    for view in range(count):
        angle, lift = math.radians(-40 + 80 * (view + 0.5) / count), 0.3 * math.sin(2.4 * view)
        centre = torch.tensor([2 * math.sin(angle), lift, 2 * math.cos(angle)], dtype=torch.float64)
        ahead = -centre / centre.norm()
        right = torch.linalg.cross(ahead, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
        right = right / right.norm()
        poses[view, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead, centre], 1)
        poses[view, 3, 3] = 1
    focal = FOCAL * width
    k = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(k.expand(count, 3, 3), poses, torch.tensor([[width, height]]).expand(count, 2))


def _seen(wall: torch.Tensor, cameras: Cameras, view: int, width: int, height: int) -> np.ndarray:
    """(height, width, 3) float32 in [0, 255]: what a camera sees of the wall, which repeats mirrored."""
    rays = image_rays(cameras, view, width, height)
    at = (rays.origins - rays.directions * (rays.origins[:, 2:] / rays.directions[:, 2:]))[:, :2].float()
    grid = at.reshape(1, height, width, 2) / 2
    seen = functional.grid_sample(wall, grid, padding_mode="reflection", align_corners=False)
    return (seen[0].permute(1, 2, 0) * 255).numpy()
