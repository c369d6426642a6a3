"""Camera poses of photos without any: pycolmap's incremental structure from motion, made predictable.

Photos are decoded, checked and turned upright by `images`, shrunk to a working size, and written for COLMAP; the
cameras that come back are for the photos' own upright size. Same photos, seed and settings: bit-identical result
(seeds set everywhere, mapping on one thread).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.media.files import exif_focal_px
from flows.media.images import read_image
from flows.readers.lenses import lens_of
from flows.readers.parsing import from_camera_from_world, pinhole
from flows.sfm.colmap import pycolmap
from flows.sfm.mapping import FROM_EXIF, Attempt, Mapper, PoseSettings, Progress, decoded, image_index

DEFAULT_FOV_DEGREES = 60.0


class PoseError(InputError):
    """Too few of the photos could be placed; the message says what helps."""


@dataclass
class PoseReport:
    """What happened. attempt: "defaults", "relaxed" (and how), or "single image"; models: registered photos in each
    model found; seconds per step; focal_source: where the first guess of the focal length came from."""

    photos: int
    registered: list[str]
    unregistered: list[str]
    attempt: str
    models: list[int] = field(default_factory=list)
    shared_camera: bool = False
    focal_source: str = ""
    points: int = 0
    reprojection_error_px: float = math.nan
    seconds: dict[str, float] = field(default_factory=dict)

    def summary(self) -> str:
        """One or two sentences for the user."""
        if self.attempt == "single image":
            return f"One photo needs no pose; its focal length is from {self.focal_source}."
        left = f" Not registered: {', '.join(self.unregistered)}." if self.unregistered else ""
        return (
            f"{len(self.registered)} of {self.photos} photos registered ({self.attempt}), {self.points} points, mean "
            f"reprojection error {self.reprojection_error_px:.2f} px.{left}"
        )


@dataclass
class PosesResult:
    """cameras of the R registered photos, in their order: OpenCV, float64, arbitrary scale, K for the upright photo;
    distortion (R, 5) k1 k2 p1 p2 k3 or None; registered: their indices; points (P, 3) in the same world."""

    cameras: Cameras
    distortion: Tensor | None
    registered: list[int]
    points: Tensor
    report: PoseReport


def estimate_poses(
    photos: Sequence[Path | str] | Sequence[np.ndarray],
    seed: int = 0,
    work_dir: Path | None = None,
    on_progress: Progress | None = None,
    masks: Sequence[Path | None] = (),
    settings: PoseSettings | None = None,
) -> PosesResult:
    """Poses of photos (files, or (H, W, 3) uint8 arrays) of one rigid scene.

    on_progress(step, done, total) with the steps "features", "matching", "mapping". masks: keypoints are taken where
    they are white. work_dir: where COLMAP's database stays (a temporary folder if None). One photo gets a camera at the
    origin. Raises InputError for an unreadable photo and PoseError when too few photos register.
    """
    if not photos:
        raise InputError("There are no photos to estimate poses for; give at least one.")
    if masks and len(masks) != len(photos):
        raise InputError(f"There are {len(photos)} photos but {len(masks)} masks; give one, or None, for each.")
    names = [f"photo {i}" for i in range(len(photos))] if decoded(photos) else [Path(p).name for p in photos]  # type: ignore[arg-type]
    progress = on_progress or (lambda step, done, total: None)
    if len(photos) == 1:
        return _single_image(photos[0], names)
    pycolmap.logging.minloglevel = 3  # its warnings are about single pairs; failures are reported here
    with tempfile.TemporaryDirectory(prefix="cat3d-poses-") as temporary:
        folder = Path(work_dir or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        job = Mapper(folder, settings or PoseSettings(), seed, progress)
        job.extract(photos, masks)
        job.match()
        return _best_result(job.map_all(), job, names)


def _best_result(attempts: list[Attempt], job: Mapper, names: list[str]) -> PosesResult:
    """The largest model of all attempts (the earlier, stricter one of equals)."""
    count = len(names)
    chosen = max(attempts, key=lambda a: a.placed)
    best = chosen.models[0] if chosen.models else None
    placed = sorted(image_index(im.name) for im in best.images.values() if im.has_pose) if best else []
    needed = max(2, math.ceil(job.settings.minimum_share * count))
    if best is None or len(placed) < needed:
        raise PoseError(_too_few(placed, names, needed))
    by_index = {image_index(im.name): im for im in best.images.values() if im.has_pose}
    intrinsics, distortion = [], []
    for i in placed:
        camera = best.cameras[by_index[i].camera_id]
        lens = lens_of(camera.model.name, camera.params.tolist(), f"the estimate for {names[i]}")
        lens.intrinsics[:2] /= torch.tensor(job.scales[i], dtype=torch.float64)[:, None]
        intrinsics.append(lens.intrinsics)
        distortion.append(lens.distortion[:5])
    poses = from_camera_from_world(torch.stack([_camera_from_world(by_index[i]) for i in placed]))
    bent = torch.stack(distortion)
    points = torch.as_tensor(np.array([p.xyz for p in best.points3D.values()]).reshape(-1, 3))
    report = PoseReport(
        photos=count,
        registered=[names[i] for i in placed],
        unregistered=[n for i, n in enumerate(names) if i not in by_index],
        attempt=chosen.name,
        models=[m.num_reg_images() for m in chosen.models],
        shared_camera=job.shared,
        focal_source=job.focal_source,
        points=len(points),
        reprojection_error_px=best.compute_mean_reprojection_error(),
        seconds=job.seconds,
    )
    cameras = Cameras(torch.stack(intrinsics), poses, torch.tensor([job.sizes[i] for i in placed]))
    return PosesResult(cameras, bent if bent.any() else None, placed, points, report)


def _camera_from_world(image: pycolmap.Image) -> Tensor:
    """(4, 4) float64, OpenCV axes."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3] = torch.as_tensor(np.array(image.cam_from_world().matrix()))
    return out


def _too_few(placed: list[int], names: list[str], needed: int) -> str:
    who = f" ({', '.join(names[i] for i in placed)})" if placed else ""
    return (
        f"Only {len(placed)} of {len(names)} photos could be placed{who}; at least {needed} are needed. What helps: "
        "more photos with smaller steps between them (neighbours should share two thirds of what they show), a "
        "textured and unmoving scene, sharp photos from one camera at one zoom; or give the cameras "
        "(transforms.json or a COLMAP model)."
    )


def _single_image(photo: Path | str | np.ndarray, names: list[str]) -> PosesResult:
    """A camera at the origin with the focal length of EXIF or of a 60 degree field of view across the long side."""
    height, width = (photo if isinstance(photo, np.ndarray) else read_image(photo)[0]).shape[:2]
    exif = None if isinstance(photo, np.ndarray) else exif_focal_px(photo)
    focal = exif or max(width, height) / (2 * math.tan(math.radians(DEFAULT_FOV_DEGREES / 2)))
    source = FROM_EXIF if exif else f"a field of view of {DEFAULT_FOV_DEGREES:g} degrees across the long side (assumed)"
    report = PoseReport(1, names, [], "single image", [1], True, source)
    cameras = Cameras(
        pinhole(focal, focal, width / 2, height / 2)[None],
        torch.eye(4, dtype=torch.float64)[None],
        torch.tensor([[width, height]]),
    )
    return PosesResult(cameras, None, [0], torch.zeros(0, 3, dtype=torch.float64), report)
