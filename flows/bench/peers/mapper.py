"""COLMAP's own steps with its own defaults, as its guide gives them: features, all pairs, the mapper."""

from __future__ import annotations

from flows.bench.peers.task import Row, Task, answer

# isort: split
import tempfile
import time
from pathlib import Path

import torch

from cat3d_core.alignment import pose_errors
from cat3d_core.cameras import Cameras
from flows.bench.poses import measure as ours
from flows.media.images import read_image, write_png
from flows.readers import read_capture
from flows.readers.splits import linspace_ids
from flows.sfm.colmap import pycolmap
from flows.sfm.poses import PoseSettings


def measure(task: Task) -> list[Row]:
    """settings: scene (a folder), views, threads."""
    scene, views = Path(task.settings["scene"]), task.settings["views"]
    row = ours(scene, views, PoseSettings().max_features)
    kept = ("registered", "rotation_deg_median", "center_share_median", "seconds")
    rows = [{"who": "cat3d", "setting": "poses"} | {name: row[name] for name in kept if name in row}]
    capture = read_capture(scene)
    ids = linspace_ids(range(len(capture)), min(views, len(capture)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images, database = folder / "images", folder / "database.db"
        images.mkdir()
        for view in ids:
            path = capture.paths[view]
            if path.suffix.lower() in (".jpg", ".jpeg", ".png"):
                (images / f"{view:05d}{path.suffix}").symlink_to(path.resolve())
            else:  # such as WebP, which COLMAP does not read
                write_png(images / f"{view:05d}.png", read_image(path)[0])
        started = time.perf_counter()
        pycolmap.extract_features(database, images)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, images, folder / "sparse")
        seconds = time.perf_counter() - started
        largest = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
        found = {"who": "COLMAP", "setting": "defaults", "seconds": seconds}
        if largest is None:
            return [*rows, found | {"registered": 0}]
        placed = {int(image.name.split(".")[0]): image for image in largest.images.values() if image.has_pose}
        registered = sorted(placed)
        truth = capture.cameras[registered]  # type: ignore[index]
        poses = torch.eye(4, dtype=torch.float64).repeat(len(registered), 1, 1)
        for pose, view in zip(poses, registered, strict=True):
            pose[:3] = torch.as_tensor(placed[view].cam_from_world().inverse().matrix())
        errors = pose_errors(Cameras(truth.intrinsics.double(), poses, truth.size), truth)
    return [
        *rows,
        found
        | {"registered": len(registered), "rotation_deg_median": float(torch.median(errors.rotation_deg)),
           "center_share_median": float(torch.median(errors.center_share))},
    ]  # fmt: skip


if __name__ == "__main__":
    answer(measure)
