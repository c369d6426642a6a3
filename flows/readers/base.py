"""What every reader yields (`Capture`), the error every bad input raises (`InputError`), and the choice of the reader.

A reader is a module of this package with three names:
  LOOKS_FOR: str                      what makes a folder its own, in words (shown when no reader fits);
  detect(path) -> bool                whether the folder is its own, by a look at file names only;
  read(path, image_folder, view_counts) -> Capture; the reader of videos also takes `frames`.
To add one: write the module, add its name to READERS where it should be tried.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.media.files import MAX_PIXELS, image_size, list_images
from flows.names import safe_name, shown, shown_names, source_path
from flows.readers.sources import scene_of

# In the order in which detection tries them: the more specific layout first, and transforms.json before the models that
# it is made from.
READERS = (
    "procedural",
    "reconfusion",
    "transforms",
    "llff",
    "dtu",
    "co3d",
    "strecha",
    "realestate10k",
    "colmap",
    "video",
    "photos",
)
VIEW_COUNTS = (1, 3, 6, 9)
#: Frames that are taken of a video.
FRAMES = 60


@dataclass
class Capture:
    """One scene as a reader found it; N views in sorted order of their file names.

    scene_id: its folder's name; after `read_capture` a name that is safe for files, and `title` the one to show.

    names (N), unique, as the data set calls them; paths (N) to image files, or images (N arrays (H, W, 3) uint8) where
    nothing lies on disk (procedural scenes); image_digests (N): what stands for those arrays in content keys, where it
    is known without them.
    cameras: OpenCV axes, float64, in the data set's own world frame; K and size belong to the image FILE as decoded,
    before undistortion. None where the poses must be estimated. upright: whether files are turned by their EXIF
    orientation; given cameras mostly belong to the pixels as stored.
    distortion (N, 5 or 8) and fisheye (N) bool: coefficients as in `media.lens.distort`, or None where there are none.
    masks (N): image files, white = object, or None per view; mask_training: pixels outside them are not trained on.
    points (P, 3): sparse scene points, world frame.
    depth_bounds (N, 2): near and far z-depth in world units. dataset: the family, which chooses
    splits and trajectories. depths (N arrays (H, W) float32): true z-depth, inf for the sky, in procedural scenes.
    splits: {"3": {"train": [indices], "test": [indices]}, ..., "all": {...}}; indices into names.
    made_from: where a text made the photo, the settings of that (`flows/generation/text.py`).
    missing: frames that the data set lists and the folder lacks. notes: sentences about what was assumed or changed.
    """

    scene_id: str
    dataset: str
    names: list[str]
    paths: list[Path] = field(default_factory=list)
    images: Sequence[np.ndarray] | None = None
    image_digests: list[str] | None = None
    cameras: Cameras | None = None
    upright: bool = True
    distortion: Tensor | None = None
    fisheye: Tensor | None = None
    masks: list[Path | None] = field(default_factory=list)
    mask_training: bool = False
    points: Tensor | None = None
    depth_bounds: Tensor | None = None
    depths: Sequence[np.ndarray] | None = None
    splits: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    made_from: dict[str, Any] | None = None
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    title: str = ""

    def __len__(self) -> int:
        return len(self.names)

    def size(self, view: int, max_pixels: int = MAX_PIXELS) -> tuple[int, int]:
        """(width, height) of a view in pixels, by its header alone. Raises InputError as `images.read_image` does."""
        if self.images is not None:
            if self.cameras is not None:  # arrays are made when they are asked for
                width, height = self.cameras.size[view].tolist()
                return width, height
            height, width = self.images[view].shape[:2]
            return width, height
        return image_size(self.paths[view], max_pixels, self.upright)

    def validate(self) -> Capture:
        """Return self, or raise InputError naming the scene and the view that cannot be used."""
        count = len(self.names)
        if count == 0:
            raise InputError(f"Scene {self.scene_id} has no images; give a folder with at least one photo.")
        twice = sorted({n for n in self.names if self.names.count(n) > 1})
        if twice:
            raise InputError(f"Scene {self.scene_id} lists {', '.join(twice[:5])} more than once; keep one of each.")
        if (self.images is None) == (not self.paths):
            raise InputError(
                f"Scene {self.scene_id} must have either image files or image arrays, and only one of them."
            )
        lengths = {
            "image files": len(self.paths) or count,
            "image arrays": count if self.images is None else len(self.images),
            "masks": len(self.masks) or count,
            "cameras": count if self.cameras is None else len(self.cameras),
            "distortion rows": count if self.distortion is None else len(self.distortion),
            "fisheye marks": count if self.fisheye is None else len(self.fisheye),
            "depth bounds": count if self.depth_bounds is None else len(self.depth_bounds),
        }
        for what, length in lengths.items():
            if length != count:
                raise InputError(f"Scene {self.scene_id} has {count} names but {length} {what}; they must match.")
        same = sorted({str(p) for p in self.paths if self.paths.count(p) > 1})
        if same:
            raise InputError(f"Scene {self.scene_id} has several views of the one file {same[0]}; keep one of them.")
        for path in [*self.paths, *(m for m in self.masks if m is not None)]:
            if not path.is_file():
                raise InputError(f"Image file {path} of scene {self.scene_id} does not exist.")
        if self.cameras is not None:
            try:
                self.cameras.validate(self.names)
            except ValueError as error:
                raise InputError(f"Scene {self.scene_id}: {error}") from None
        for what in ("distortion", "points", "depth_bounds"):
            values = getattr(self, what)
            if values is not None and not values.isfinite().all():
                raise InputError(f"Scene {self.scene_id} has a NaN or infinite number in its {what.replace('_', ' ')}.")
        for name, split in self.splits.items():
            self._validate_split(name, split)
        return self

    def _validate_split(self, name: str, split: dict[str, list[int]]) -> None:
        where = f'Split "{name}" of scene {self.scene_id}'
        if not split["train"]:
            raise InputError(f"{where} has no training view; it needs at least one.")
        for role, ids in split.items():
            outside = [i for i in ids if not 0 <= i < len(self.names)]
            if outside:
                raise InputError(
                    f"{where}: {role} id {outside[0]} is out of range; the scene has {len(self.names)} images "
                    f"(ids 0 to {len(self.names) - 1})."
                )
            if len(set(ids)) != len(ids):
                raise InputError(f"{where} lists a {role} view twice; list each once.")
        shared = sorted(set(split["train"]) & set(split["test"]))
        if shared:
            raise InputError(f"{where} has view {shared[0]} both for training and for testing; choose one.")


def read_capture(
    path: str | Path,
    reader: str = "auto",
    image_folder: str | None = None,
    view_counts: Sequence[int] = VIEW_COUNTS,
    frames: int = FRAMES,
) -> Capture:
    """Read the scene at `path` (a folder, one of its files, or a spec such as procedural:room/3) and validate it.

    path may be text by `names.source_text`. reader: a name of READERS, or "auto" for the first that recognises the
    folder. image_folder: which of several image folders to take (images_4, ...), where the layout has them.
    view_counts: which few-view splits to make. frames: how many of a video. Raises InputError for everything a user can
    correct.
    """
    if reader != "auto" and reader not in READERS:
        raise InputError(f'There is no reader "{reader}"; the readers are: auto, {", ".join(READERS)}.')
    if not view_counts or min(view_counts) <= 0:
        raise InputError(f"View counts must be positive numbers; got {list(view_counts)}.")
    given: str | Path = path
    notes: list[str] = []
    if not str(path).startswith("procedural:"):
        # A path to a file that only some readers know (a camera list, a photo) is left to those.
        given, reader = scene_of(Path(source_path(str(path))), reader)
    chosen = reader
    if reader == "auto":
        chosen = "procedural" if isinstance(given, str) else _detected(given)
        if isinstance(given, Path) and given.is_dir():
            notes = _others(given, chosen)
    module = importlib.import_module(f"flows.readers.{chosen}")
    extra = {"frames": frames} if chosen == "video" else {}
    capture: Capture = module.read(given, image_folder, tuple(view_counts), **extra)
    capture.names = shown_names(capture.names)
    capture.title, capture.scene_id = shown(capture.scene_id), safe_name(capture.scene_id)
    capture.notes = [shown(note) for note in [*capture.notes, *notes]]
    return capture.validate()


def _detected(path: Path) -> str:
    """The first reader that recognises a folder or file; photos in subfolders only where those are no scenes."""
    looked_for = []
    for name in READERS:
        module = importlib.import_module(f"flows.readers.{name}")
        if module.detect(path):
            inner = _scenes_in(path) if name == "photos" and path.is_dir() else []
            if inner:
                raise InputError(
                    f"{path} is no scene itself, but holds {len(inner)}: give the folder of one, such as {inner[0]}."
                )
            return name
        looked_for.append(f"  {name}: {module.LOOKS_FOR}")
    raise InputError(f"{path} is not a scene that a reader recognises. Looked for:\n" + "\n".join(looked_for))


def _scenes_in(path: Path) -> list[Path]:
    """Subfolders with cameras of their own, where the folder itself has no images."""
    if list_images(path):
        return []
    below = [p for p in sorted(path.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    named = [
        importlib.import_module(f"flows.readers.{n}") for n in READERS if n not in ("photos", "procedural", "video")
    ]
    return [folder for folder in below if any(module.detect(folder) for module in named)]


def _others(path: Path, chosen: str) -> list[str]:
    """A note for each other description of the scene in the same folder."""
    same = {"reconfusion", "transforms"}
    names = [n for n in READERS if n not in (chosen, "photos", *(same if chosen in same else ()))]
    return [
        f"The reader {chosen} was used. The folder also fits the reader {name}: --reader {name} takes that instead."
        for name in names
        if importlib.import_module(f"flows.readers.{name}").detect(path)
    ]
