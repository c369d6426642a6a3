"""ReconFusion / SEVA benchmark folders: transforms.json and train_test_split_{3,6,9}.json.

train_ids and test_ids index the frames of transforms.json in the order of the file (as SEVA's ReconfusionParser reads
them; the published files list their frames sorted).
"""

from __future__ import annotations

import re
from pathlib import Path

from flows.errors import InputError
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.parsing import load_json, unlisted_note
from flows.readers.transforms import to_capture
from flows.readers.transforms_file import load_frames

LOOKS_FOR = "transforms.json with train_test_split_3.json, _6 or _9 (ReconFusion, SEVA)"
PATTERN = re.compile(r"train_test_split_(\d+)\.json")


def detect(path: Path) -> bool:
    return (path / "transforms.json").is_file() and bool(_split_files(path))


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Few-view splits come from the files only; "all" holds out the test views of the largest."""
    files = _split_files(path)
    if not files:
        raise InputError(f"{path} has no train_test_split_N.json; use the reader transforms for it.")
    listing = load_frames(path, "transforms.json", image_folder)
    frames = listing.frames
    capture = to_capture(path, listing)
    total = len(frames) + len(listing.missing)
    view_of = {frame.json_id: view for view, frame in enumerate(frames)}
    for count, source in files.items():
        content = load_json(source)
        split = {}
        for role in ("train", "test"):
            ids = content.get(f"{role}_ids") if isinstance(content, dict) else None
            if not isinstance(ids, list) or not all(isinstance(i, int) and not isinstance(i, bool) for i in ids):
                raise InputError(f'{source} has no list of whole numbers "{role}_ids".')
            outside = [i for i in ids if not 0 <= i < total]
            if outside:
                raise InputError(
                    f"{source}: {role} id {outside[0]} is out of range; transforms.json lists {total} frames "
                    f"(ids 0 to {total - 1})."
                )
            split[role] = [view_of[i] for i in ids if i in view_of]
            if len(split[role]) < len(ids):
                gone = [str(i) for i in ids if i not in view_of]
                capture.notes.append(
                    f"{source.name}: " + unlisted_note(len(gone), f"{role} views have no image and were", gone)
                )
        capture.splits[str(count)] = split
    most = max(files)
    held_out = capture.splits[str(most)]["test"]
    capture.splits["all"] = splits.held_out(len(frames), held_out, ())["all"]
    capture.notes.append(f"Splits are those of {', '.join(f.name for f in files.values())}.")
    lacking = [str(c) for c in view_counts if c not in files]
    if lacking:
        capture.notes.append(f"The folder has no split for {', '.join(lacking)} views.")
    return capture


def _split_files(path: Path) -> dict[int, Path]:
    """{number of training views: file}, ascending."""
    matches = ((PATTERN.fullmatch(p.name), p) for p in sorted(path.glob("train_test_split_*.json")))
    return dict(sorted((int(m.group(1)), p) for m, p in matches if m))
