"""Generated views that another program made for a run's plan: which pictures they are, and that a run has them.

They are named by planned view, view_0000.png and so on. Once imported they stand in the place of what a generator
makes: nothing is encoded or sampled, and the stage `decode` takes them over.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.jobs.job import Job
from flows.jobs.scene import file_sha256
from flows.media.files import image_size, list_images
from flows.media.images import read_image
from schemas.errors import MissingError
from schemas.scene_store import Run, SceneStore

_NAME = re.compile(r"view_(\d+)")


def view_name(view: int) -> str:
    """What the picture of a planned view is called."""
    return f"view_{view:04d}.png"


@dataclass(frozen=True)
class Imported:
    """Pictures of planned views. folder: where they came from; note: what made them; sha256: of them all; plan: the key
    of the plan they were made for; views: their numbers."""

    folder: str
    note: str
    sha256: str
    plan: str
    views: list[int]

    def __str__(self) -> str:
        made = f", made by {self.note}" if self.note else ""
        return f"{len(self.views)} generated views were imported from {self.folder}{made}."


def imported_into(run: Run) -> Imported | None:
    """What was imported into a run; None where its views are a generator's."""
    document: dict[str, Any] | None = run.generated.attrs.get("imported")
    return Imported(**document) if document else None


def imported(job: Job) -> Imported | None:
    """The same of a job's run."""
    try:
        store = SceneStore.open(job.store_path)
    except MissingError:
        return None
    return imported_into(store.run(job.run)) if job.run in store.runs() else None


def samples(job: Job) -> bool:
    """For `Stage.wanted`: where views are generated here."""
    return job.generates and imported(job) is None


def find_views(folder: Path, cameras: Cameras, partial: bool) -> dict[int, Path]:
    """The picture of each planned view, N cameras in all. partial: some may be missing.

    Raises InputError for extra, duplicate, missing and wrongly sized pictures, each with its name and what to do.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give the one with the pictures of the planned views.")
    last = view_name(len(cameras) - 1)
    found: dict[int, Path] = {}
    for path in list_images(folder):
        match = _NAME.fullmatch(path.stem)
        if match is None or int(match[1]) >= len(cameras):
            raise InputError(
                f"{path} is no planned view: their pictures are {view_name(0)} to {last}. Take it out of the folder."
            )
        view = int(match[1])
        if view in found:
            raise InputError(f"Planned view {view} is there twice: {found[view].name} and {path.name}. Keep one.")
        found[view] = path
    missing = sorted(set(range(len(cameras))) - set(found))
    if missing and (not partial or not found):
        raise InputError(
            f"{folder} lacks {len(missing)} of {len(cameras)} planned views, the first is {view_name(missing[0])}: "
            "make them too, or go on without them by --partial."
        )
    for view, path in found.items():
        if (size := list(image_size(path))) != (wanted := cameras.size[view].tolist()):
            raise InputError(
                f"{path} is {size[0]} x {size[1]} pixels, but the plan's views are {wanted[0]} x {wanted[1]}: make it "
                "that large, or plan views of its size (plan.image_size)."
            )
    return dict(sorted(found.items()))


def digest(files: dict[int, Path]) -> str:
    """sha256 of the pictures and of which views they are."""
    text = "\n".join(f"{view} {file_sha256(path)}" for view, path in sorted(files.items()))
    return hashlib.sha256(text.encode()).hexdigest()


def read_view(path: Path) -> NDArray[np.uint8]:
    """(1, H, W, 3): the picture of a view."""
    image, _ = read_image(path)
    return image[None]
