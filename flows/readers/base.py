"""What every reader yields (`Capture`), the error every bad input raises (`InputError`), and the choice of the reader.

A reader is a module of this package with three names:
  LOOKS_FOR: str                      what makes a folder its own, in words (shown when no reader fits);
  detect(path) -> bool                whether the folder is its own, by a look at file names only;
  read(path, image_folder, view_counts) -> Capture.
To add one: write the module, add its name to READERS where it should be tried.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from cat3d_core.cameras import Cameras
from flows.errors import InputError

# In the order in which detection tries them: the more specific layout first.
READERS = (
    "procedural",
    "reconfusion",
    "llff",
    "dtu",
    "co3d",
    "strecha",
    "realestate10k",
    "colmap",
    "transforms",
    "photos",
)
VIEW_COUNTS = (1, 3, 6, 9)


@dataclass
class Capture:
    """One scene as a reader found it; N views in sorted order of their file names.

    names (N), unique, as the data set calls them; paths (N) to image files, or images (N arrays (H, W, 3) uint8) where
    nothing lies on disk (procedural scenes); image_digests (N): what stands for those arrays in content keys, where it
    is known without them.
    cameras: OpenCV axes, float64, in the data set's own world frame; K and size belong to the image FILE as decoded
    and turned upright by its EXIF orientation, before undistortion. None where the poses must be estimated.
    distortion (N, 5): k1, k2, p1, p2, k3 in OpenCV's order and meaning, or None where there is none.
    masks (N): image files, white = object, or None per view. points (P, 3): sparse scene points, world frame.
    depth_bounds (N, 2): near and far z-depth in world units. dataset: the family, which chooses
    splits and trajectories. depths (N arrays (H, W) float32): true z-depth, inf for the sky, in procedural scenes.
    splits: {"3": {"train": [indices], "test": [indices]}, ..., "all": {...}}; indices into names.
    missing: frames that the data set lists and the folder lacks. notes: sentences about what was assumed or changed.
    """

    scene_id: str
    dataset: str
    names: list[str]
    paths: list[Path] = field(default_factory=list)
    images: Sequence[np.ndarray] | None = None
    image_digests: list[str] | None = None
    cameras: Cameras | None = None
    distortion: Tensor | None = None
    masks: list[Path | None] = field(default_factory=list)
    points: Tensor | None = None
    depth_bounds: Tensor | None = None
    depths: Sequence[np.ndarray] | None = None
    splits: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)

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
            "depth bounds": count if self.depth_bounds is None else len(self.depth_bounds),
        }
        for what, length in lengths.items():
            if length != count:
                raise InputError(f"Scene {self.scene_id} has {count} names but {length} {what}; they must match.")
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
) -> Capture:
    """Read the scene at `path` (a folder, or a spec such as procedural:room/3) and validate it.

    reader: a name of READERS, or "auto" for the first that recognises the folder. image_folder: which of several image
    folders to take (images_4, ...), where the layout has them. view_counts: which few-view splits to make.
    Raises InputError for everything a user can correct.
    """
    if reader != "auto" and reader not in READERS:
        raise InputError(f'There is no reader "{reader}"; the readers are: auto, {", ".join(READERS)}.')
    if not view_counts or min(view_counts) <= 0:
        raise InputError(f"View counts must be positive numbers; got {list(view_counts)}.")
    is_spec = str(path).startswith("procedural:")
    if not is_spec and not Path(path).exists():
        raise InputError(f"{path} does not exist; give the folder of a scene.")
    # read() of a path that is a file (a camera list) is left to the readers that know such files.
    chosen = reader if reader != "auto" else ("procedural" if is_spec else _detected(Path(path)))
    module = importlib.import_module(f"flows.readers.{chosen}")
    capture: Capture = module.read(path if is_spec else Path(path), image_folder, tuple(view_counts))
    return capture.validate()


def _detected(path: Path) -> str:
    looked_for = []
    for name in READERS:
        module = importlib.import_module(f"flows.readers.{name}")
        if module.detect(path):
            return name
        looked_for.append(f"  {name}: {module.LOOKS_FOR}")
    raise InputError(f"{path} is not a scene that a reader recognises. Looked for:\n" + "\n".join(looked_for))


def inside(root: Path, name: str, source: Path | str) -> Path:
    """The file `name` (as written in the data file `source`) below `root`, which it must not leave.

    Raises InputError for an absolute path, one with `..`, and one that a symbolic link leads out of the folder. The
    file itself need not exist.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"{source} has {name!r} where the name of a file is expected.")
    relative = Path(name.replace("\\", "/"))
    if relative.is_absolute() or ".." in relative.parts or ":" in relative.parts[0]:
        raise InputError(
            f'{source} names the file "{name}", which is outside the scene\'s folder; '
            "use a path relative to the folder and without .. in it."
        )
    target = root / relative
    if not target.resolve().is_relative_to(root.resolve()):
        raise InputError(
            f"{source} names the file '{name}', which a symbolic link leads out of {root}; "
            "copy the file into the folder."
        )
    return target
