"""RealEstate10K: the published camera list of a clip and a folder of its frames.

First line: the video's address. Then a line per frame: timestamp (microseconds), fx, fy, cx, cy in units of the image's
width and height, two zeros, and the 3 x 4 world-to-camera matrix by rows (OpenCV axes). Frames are image files named by
timestamp, beside the list or in a folder named frames, images, or as the list.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch

from flows.errors import InputError
from flows.media.files import list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import cameras_for_files, files_size, from_camera_from_world, images_in, unlisted_note

LOOKS_FOR = "a clip's .txt of 19 numbers a line below a video address, with frames named by timestamp (RealEstate10K)"
COLUMNS = 19


def detect(path: Path) -> bool:
    return _camera_list(path) is not None


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Frames in order of time; listed ones without an image are reported and left out."""
    source = _camera_list(path)
    if source is None:
        raise InputError(f"{path} has no camera list of RealEstate10K (a .txt with {COLUMNS} numbers a line).")
    rows = _rows(source)
    folder, files = _frames(source, image_folder)
    if not all(math.isfinite(row[0]) for row in rows):
        raise InputError(f"{source} has a line whose timestamp is no finite number; mend or remove it.")
    listed = {int(row[0]): row for row in rows}
    if len(listed) != len(rows):
        raise InputError(f"{source} lists a timestamp more than once; keep one line for each frame.")
    times = sorted(t for t in listed if t in files)
    missing = [str(t) for t in sorted(listed) if t not in files]
    if not times:
        raise InputError(
            f"None of the {len(listed)} timestamps of {source} (first: {rows[0][0]:.0f}) is the name of an "
            f"image in {folder}."
        )
    table = torch.tensor([listed[t] for t in times], dtype=torch.float64)
    paths = [files[t] for t in times]
    names = [p.name for p in paths]
    size = files_size(paths).double()
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(len(times), 1, 1)
    intrinsics[:, [0, 1], [0, 1]] = table[:, 1:3] * size
    intrinsics[:, :2, 2] = table[:, 3:5] * size
    camera_from_world = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
    camera_from_world[:, :3] = table[:, 7:].reshape(-1, 3, 4)
    notes = [unlisted_note(len(missing), "listed frames without an image were", missing)] if missing else []
    without = [p.name for p in list_images(folder) if p not in paths]
    if without:
        notes.append(unlisted_note(len(without), f"images of {folder.name} whose name is no listed time were", without))
    poses = from_camera_from_world(camera_from_world)
    placed = cameras_for_files(intrinsics, size, poses, paths, names, source, notes)
    return Capture(
        scene_id=source.stem,
        dataset="realestate10k",
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        splits=splits.every_8th(len(times), view_counts),
        missing=missing,
        notes=[*notes, splits.EVERY_8TH],
    )


def _rows(source: Path) -> list[list[float]]:
    rows = []
    for number, line in enumerate(source.read_text(encoding="utf-8-sig", errors="replace").splitlines()[1:], start=2):
        parts = line.split()
        try:
            values = [float(x) for x in parts]
        except ValueError:
            raise InputError(
                f"{source}, line {number}: expected {COLUMNS} numbers, got {line.strip()[:60]!r}."
            ) from None
        if values and len(values) != COLUMNS:
            raise InputError(f"{source}, line {number}: expected {COLUMNS} numbers, got {len(values)}.")
        if values:
            rows.append(values)
    if not rows:
        raise InputError(f"{source} lists no frame.")
    return rows


def _frames(source: Path, image_folder: str | None) -> tuple[Path, dict[int, Path]]:
    """The folder of frames, and {timestamp: file}."""
    scene = source.parent
    names = (image_folder,) if image_folder else ("frames", "images", source.stem, ".")
    folder = next((scene / n for n in names if (scene / n).is_dir() and list_images(scene / n)), None)
    if folder is None:
        raise InputError(f"{source} has no folder of frames beside it; looked for {', '.join(names)}.")
    return folder, {int(p.stem): p for p in images_in(folder, scene) if p.stem.isdigit()}


def _camera_list(path: Path) -> Path | None:
    candidates = [path] if path.is_file() else sorted(path.glob("*.txt"))
    for candidate in candidates:
        if candidate.suffix == ".txt":
            with candidate.open(encoding="utf-8-sig", errors="replace") as stream:
                head = [stream.readline(4096) for _ in range(2)]
            if head[0].startswith("http") and len(head[1].split()) == COLUMNS:
                return candidate
    return None
