"""What the user points at: a scene's folder, or one of the files in it, or something that has to be unpacked first."""

from __future__ import annotations

from pathlib import Path

from flows.errors import InputError
from flows.media.files import VIDEOS, is_image

#: File of a layout -> its reader; the folder it lies in is the scene.
SCENE_FILES = {
    "poses_bounds.npy": "llff",
    "cameras_sphere.npz": "dtu",
    "cameras.npz": "dtu",
    "cameras_large.npz": "dtu",
    "gt_cameras.npz": "co3d",
    "transforms_train.json": "transforms",
    "transforms_test.json": "transforms",
    "transforms_val.json": "transforms",
}
MODEL_FILES = frozenset(f"{part}.{kind}" for part in ("cameras", "images", "points3D") for kind in ("bin", "txt"))
ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".7z", ".rar", ".zst")


def scene_of(path: Path, reader: str = "auto") -> tuple[Path, str]:
    """The path that a reader is to read, and the reader ("auto" where its layout is still to be detected).

    A file of a layout stands for its folder. Raises InputError with the next step for what is not there and for files
    that are no scene.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; give the folder of a scene.")
    if path.is_dir():
        return path, reader
    name, kind = path.name, path.suffix.lower()
    if kind in ARCHIVES and name != "frame_annotations.jgz":
        raise InputError(f"{path} is an archive; unpack it and give the folder that comes out.")
    if name in SCENE_FILES:
        return path.parent, SCENE_FILES[name] if reader == "auto" else reader
    if name in MODEL_FILES:
        return path.parent, "colmap" if reader == "auto" else reader
    if kind == ".json":
        return path, "transforms" if reader == "auto" else reader
    if kind == ".camera":
        above = path.parent.name in ("gt_dense_cameras", "cameras")
        return path.parent.parent if above else path.parent, "strecha" if reader == "auto" else reader
    if name == "frame_annotations.jgz":
        raise InputError(f"{path} describes a category of CO3D; give the folder of one of its sequences.")
    if kind == ".txt" or kind[1:] in VIDEOS or is_image(path):
        return path, reader
    raise InputError(
        f"{path} is a file of a kind that is no scene; give the folder with the photos, a video, or a transforms.json."
    )
