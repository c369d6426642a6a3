"""Stage ingest: image files -> undistorted, downscaled uint8 images in the store."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, settings_of
from flows.media import images
from flows.progress import console, meter
from flows.readers.base import Capture
from flows.sfm.consistency import check_consistency
from schemas.config import IngestConfig, RunConfig
from schemas.decisions import chosen, warning
from schemas.scene_store import SceneStore

#: Views that are made ahead of what is written, at most.
CHUNK = 4


class Ingested(NamedTuple):
    """One view: image (h, w, 3) uint8, mask (h, w) uint8 or None, intrinsics (3, 3) of that image or None."""

    image: np.ndarray
    mask: np.ndarray | None
    intrinsics: Tensor | None


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The photos and their lens; where cameras are estimated although the source has some, the pose stage writes other
    images over these."""
    found = {name: job.scene.digests[name] for name in ("images", "lens")}
    return found | ({"estimate": "always"} if job.config.poses.estimate == "always" else {})


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `captured/`: image, size, name, source_sha256, and mask and intrinsics where the data set has them."""
    capture = job.capture()
    count = len(capture)
    store.captured.set_attrs(made_from=capture.made_from)
    with meter(f"ingest {job.scene_id}", count) as progress:

        def one(view: int) -> Ingested:
            out = ingest_view(capture, view, job.config.ingest)
            progress.advance(note=capture.names[view])
            return out

        pixels = write_captured(store, capture, job, in_chunks(one, count))
    read = sum(math.prod(capture.size(view)) for view in range(count))
    decisions = [warning(note) for note in capture.notes]
    if job.working_size:
        decisions.append(chosen(job.working_size))
    if capture.distortion is not None:
        decisions.append(chosen("The images were undistorted; the stored intrinsics are those of the pinhole images."))
    if capture.paths and job.config.ingest.check_cameras:
        with console.status(f"Checking the cameras of {job.scene_id}"):
            decisions += [warning(text) for text in check_consistency(capture)]
    return Outcome({"views": count, "pixels": pixels, "pixels_read": read}, decisions)


def in_chunks(one: Callable[[int], Ingested], count: int) -> Iterator[Ingested]:
    """one(view) of all views in order, made by two threads, at most CHUNK of them ahead of what was taken."""
    with ThreadPoolExecutor(2) as pool:
        for first in range(0, count, CHUNK):
            yield from pool.map(one, range(first, min(first + CHUNK, count)))


def write_captured(store: SceneStore, capture: Capture, job: Job, views: Iterable[Ingested]) -> int:
    """Write all views' images (padded to the largest), sizes, names and digests, and K where it is known, a view at a
    time; how many pixels they are."""
    captured = store.captured
    sizes = np.array([stored_size(capture, view, job.config.ingest) for view in range(len(capture))], np.int32)
    width, height = sizes.max(0)
    captured.set_attrs(title=capture.title, mask_training=capture.mask_training)
    captured.write("size", sizes)
    captured.write("name", np.array(capture.names, dtype=object))
    captured.write("source_sha256", np.array(list(job.scene.digests["images"].values()), dtype=object))
    captured.create_array("image", (len(sizes), height, width, 3))
    known, unmasked, masked = [], [], False
    for view, one in enumerate(views):
        captured.write_images("image", [one.image], [view])
        if one.intrinsics is not None:
            known.append(one.intrinsics)
        if one.mask is None:
            unmasked.append(view)
            continue
        if not masked:
            captured.create_array("mask", (len(sizes), height, width))
            masked = True
        captured.write_images("mask", [one.mask], [view])
    for view in unmasked if masked else ():
        captured.write_images("mask", [np.full(sizes[view][::-1], 255, np.uint8)], [view])
    if not masked:
        captured.remove("mask")
    if len(known) == len(sizes):
        captured.write("intrinsics", torch.stack(known).numpy())
    else:
        captured.remove("intrinsics")
    return int(sizes.astype(np.int64).prod(1).sum())


def stored_size(capture: Capture, view: int, settings: IngestConfig) -> tuple[int, int]:
    """(width, height) that a view has in the store."""
    width, height = capture.size(view, settings.max_pixels)
    scale = settings.downscale or 1.0
    return max(1, round(width / scale)), max(1, round(height / scale))


def ingest_view(
    capture: Capture,
    view: int,
    settings: IngestConfig,
    distortion: Tensor | None = None,
    camera: Cameras | None = None,
) -> Ingested:
    """Read one view, undistort it at full size, then shrink it.

    camera and distortion override the capture's own (for poses that were estimated).
    Raises InputError for an unreadable image or one whose size contradicts its camera.
    """
    if capture.images is not None:
        image, alpha = capture.images[view], None
    else:
        image, alpha = images.read_image(capture.paths[view], max_pixels=settings.max_pixels, upright=capture.upright)
    mask = alpha
    mask_path = capture.masks[view] if capture.masks else None
    if mask_path is not None:
        mask = images.read_mask(mask_path, upright=capture.upright)
        if capture.mask_training and not mask.any():
            raise InputError(
                f"The mask {mask_path} of {capture.names[view]} is black everywhere, which leaves no pixel to train "
                "on; mend the mask (white is what counts), or leave the view out."
            )
        if mask.shape != image.shape[:2]:
            mask = images.resize(mask, image.shape[1], image.shape[0])
    height, width = image.shape[:2]
    if camera is None and capture.cameras is not None:
        camera = capture.cameras[view]
    fisheye = False
    if distortion is None and capture.distortion is not None:
        distortion = capture.distortion[view]
        fisheye = capture.fisheye is not None and bool(capture.fisheye[view])
    if camera is not None and camera.size[0].tolist() != [width, height]:
        raise InputError(
            f"Image {capture.names[view]} is {width} x {height} pixels, but its camera is for "
            f"{camera.size[0, 0]} x {camera.size[0, 1]}; give the image the camera belongs to."
        )
    if camera is not None and distortion is not None and (fisheye or distortion.any()):
        original = camera.intrinsics[0]
        image, intrinsics = images.undistort(image, original, distortion, fisheye=fisheye)
        if mask is not None:
            mask, _ = images.undistort(mask, original, distortion, nearest=True, fisheye=fisheye)
        camera = Cameras(intrinsics[None], camera.world_from_camera, camera.size)
    small_width, small_height = stored_size(capture, view, settings)
    image = images.resize(image, small_width, small_height)
    if mask is not None:
        mask = images.resize(mask, small_width, small_height)
    small = None if camera is None else camera.resize(small_width, small_height).intrinsics[0]
    return Ingested(image, mask, small)


# The digests of a video's frames cover which those are, and the check only warns.
_given = settings_of("ingest", without=("frames", "check_cameras"))


def ingest_settings(config: RunConfig) -> dict[str, Any]:
    """The settings; photos of which no size was chosen are taken whole."""
    given = _given(config)
    return given | {"downscale": given["downscale"] or 1.0}


STAGE = Stage("ingest", execute, version=1, settings=ingest_settings, inputs=inputs)
