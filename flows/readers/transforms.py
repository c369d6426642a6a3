"""nerfstudio and instant-ngp: transforms.json; NeRF's synthetic scenes: transforms_train.json and _test.json.

camera-to-world matrices with OpenGL camera axes; intrinsics global or per frame, in pixels of w x h or as angles of
view; OpenCV or fisheye distortion. nerfstudio writes the poses with `applied_transform` already applied; it is undone
here, so that the world is that of the original reconstruction.
"""

from __future__ import annotations

from pathlib import Path

import torch

from flows.errors import InputError
from flows.media.files import image_size, list_images
from flows.readers import splits
from flows.readers.base import Capture
from flows.readers.lenses import stacked
from flows.readers.matching import left_out
from flows.readers.parsing import cameras_for_files, family_of, from_opengl, implied_size, unlisted_note
from flows.readers.transforms_file import Listing, calibrated_size, lens, load_frames, pose, stored_size

LOOKS_FOR = "transforms.json, or transforms_train.json (NeRF synthetic)"
SYNTHETIC_PARTS = ("train", "val", "test")
ROLES = ("train", "val", "test")
#: What instant-ngp puts before the names of photos for masks of what moves; white is left out there.
DYNAMIC = "dynamic_mask_"


def detect(path: Path) -> bool:
    return (path / "transforms.json").is_file() or (path / "transforms_train.json").is_file()


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...]) -> Capture:
    """Frames in sorted order of file_path; those without an image are reported and left out. `path` may be the file."""
    folder, file_name = (path.parent, path.name) if path.is_file() else (path, "transforms.json")
    if (folder / file_name).is_file():
        listing = load_frames(folder, file_name, image_folder)
        capture = to_capture(folder, listing)
        _split(capture, listing, view_counts)
        return capture
    parts = [p for p in SYNTHETIC_PARTS if (path / f"transforms_{p}.json").is_file()]
    if "train" not in parts:
        raise InputError(f"{path} has neither transforms.json nor transforms_train.json.")
    return _read_synthetic(path, parts, view_counts)


def to_capture(path: Path, listing: Listing) -> Capture:
    """Cameras, lenses and masks of the frames, without splits."""
    frames, notes, source = listing.frames, list(listing.notes), listing.frames[0].source
    names, paths = [f.name for f in frames], [f.path for f in frames]
    if listing.missing:
        notes.append(unlisted_note(len(listing.missing), "frames whose image is missing were", listing.missing))
    notes += _unlisted(path, listing)
    said = [calibrated_size(f) for f in frames]
    sizes = [size or stored_size(f, listing) for f, size in zip(frames, said, strict=True)]
    lenses = [lens(f, size) for f, size in zip(frames, sizes, strict=True)]
    intrinsics, distortion, fisheye = stacked(lenses)
    calibrated = torch.tensor(sizes, dtype=torch.float64)
    silent = [i for i, size in enumerate(said) if size is None]
    if silent:
        others = _other_sizes(path, frames[silent[0]].path.name)
        calibrated[silent] = implied_size(intrinsics[silent], calibrated[silent], others, source, notes)
    placed = cameras_for_files(
        intrinsics, calibrated, from_opengl(torch.stack([pose(f) for f in frames])), paths, names, source, notes
    )
    masks = _masks(listing, notes)
    return Capture(
        scene_id=path.resolve().name,
        dataset=family_of(path),
        names=names,
        paths=paths,
        cameras=placed.cameras,
        upright=placed.upright,
        distortion=distortion,
        fisheye=fisheye,
        masks=masks,
        mask_training=bool(masks),
        missing=listing.missing,
        notes=notes,
    )


def _masks(listing: Listing, notes: list[str]) -> list[Path | None]:
    """The frames' mask_path: pixels that are black there are neither trained on nor measured."""
    named = [f.entry.get("mask_path") for f in listing.frames]
    moving = [f.name for f in listing.frames if (f.path.parent / f"{DYNAMIC}{f.path.stem}.png").is_file()]
    if moving:
        notes.append(
            f"instant-ngp's masks of what moves ({DYNAMIC}NAME.png, of {len(moving)} photos) are not read: give them "
            "as mask_path of the frames, with black where nothing is to be trained on."
        )
    if not any(named):
        return []
    found = [listing.finder.find_all([m])[0] if m else None for m in named]
    lacking = [f.name for f, mask in zip(listing.frames, found, strict=True) if mask is None]
    if len(lacking) == len(found):
        raise InputError(
            f"{listing.frames[0].source} names masks, but none of them exists (first: {next(m for m in named if m)}); "
            "put them there, or remove mask_path."
        )
    notes.append("Masks are those of mask_path: black pixels are not trained on.")
    if lacking:
        notes.append(f"{len(lacking)} frames have no mask and count whole: {', '.join(lacking[:12])}.")
    return found


def _split(capture: Capture, listing: Listing, view_counts: tuple[int, ...]) -> None:
    """The file's own lists of training and held-out views, else every 8th."""
    lists = {r: listing.header[f"{r}_filenames"] for r in ROLES if listing.header.get(f"{r}_filenames") is not None}
    source = listing.frames[0].source
    if not lists:
        capture.splits = splits.every_8th(len(capture), view_counts)
        capture.notes.append(splits.EVERY_8TH)
        return
    views: dict[str, list[int]] = {}
    for role, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise InputError(f'{source}: "{role}_filenames" is not a list of file names.')
        views[role], unknown = listing.views(names)
        if unknown:
            left = f"names of {role}_filenames that are no frame with an image were"
            capture.notes.append(unlisted_note(len(unknown), left, unknown))
    test_role = "test" if views.get("test") else "val"
    test = views.get(test_role, [])
    held_out = {i for role in ("val", "test") for i in views.get(role, [])}
    train = views.get("train", [i for i in range(len(capture)) if i not in held_out])
    both = sorted(set(train) & set(test))
    if both:
        raise InputError(
            f"{source} lists {capture.names[both[0]]} in train_filenames and in {test_role}_filenames; choose one."
        )
    capture.splits = splits.of_lists(train, test, view_counts)
    used = f"{test_role}_filenames" if test else "none, as no held-out view is listed"
    capture.notes.append(
        f"Split: training views are those of {'train_filenames' if 'train' in views else 'no list of held-out views'}, "
        f"test views those of {used}; few-view splits are a rounded linspace over the training views."
    )
    idle = [capture.names[i] for i in range(len(capture)) if i not in set(train) | set(test)]
    if idle:
        capture.notes.append(unlisted_note(len(idle), "views in no list of the split in use were", idle))


def _read_synthetic(path: Path, parts: list[str], view_counts: tuple[int, ...]) -> Capture:
    listings, roles = [], []
    for part in parts:
        try:
            found = load_frames(path, f"transforms_{part}.json")
        except InputError as error:
            if part == "train" or "none of their images" not in str(error):
                raise
            continue
        found.frames.sort(key=lambda f: f.json_id)  # r_0, r_1, ... r_10: the file's order is the numbers' order
        listings.append(found)
        roles += [part] * len(found.frames)
    first = listings[0]
    frames = [f for listing in listings for f in listing.frames]
    missing = [m for listing in listings for m in listing.missing]
    notes = list(dict.fromkeys(n for listing in listings for n in listing.notes))
    capture = to_capture(path, Listing(frames, missing, first.finder, None, first.header, notes))
    capture.dataset = "nerf_synthetic"
    train = [i for i, role in enumerate(roles) if role == "train"]
    test = [i for i, role in enumerate(roles) if role == "test"]
    capture.splits = splits.of_lists(train, test, view_counts)
    capture.notes.append(
        "Split rule: test views are those of transforms_test.json, training views a rounded linspace over the others."
    )
    return capture


def _unlisted(path: Path, listing: Listing) -> list[str]:
    """A note about photos beside the listed ones that no frame names."""
    parents = {f.path.parent for f in listing.frames}
    folder = next(iter(parents))
    if len(parents) > 1 or folder == path:
        return []
    names = [n for n in left_out(folder, [f.path for f in listing.frames], path) if "/" not in n]
    masks = {str(f.entry.get("mask_path", "")).replace("\\", "/").split("/")[-1] for f in listing.frames}
    names = [n for n in names if n not in masks and not any(word in n for word in ("depth", "normal", DYNAMIC))]
    return (
        [unlisted_note(len(names), f"photos of the folder {folder.name} that no frame names were", names)]
        if names
        else []
    )


def _other_sizes(path: Path, name: str) -> list[tuple[float, float]]:
    """Sizes of the photo, or of the first one, in the scene's other image folders, the largest first."""
    sizes = []
    for folder in sorted(p for p in path.iterdir() if p.is_dir() and p.resolve().is_relative_to(path.resolve())):
        files = list_images(folder)
        file = next((f for f in files if f.stem == Path(name).stem), files[0] if files else None)
        if file is not None and "mask" not in folder.name:
            sizes.append(tuple(map(float, image_size(file, upright=False))))
    return sorted(set(sizes), reverse=True)  # type: ignore[arg-type]
