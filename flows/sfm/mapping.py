"""COLMAP's steps for one set of photos: keypoints, matches, and the attempts at incremental mapping.

Everything is seeded and mapping runs on one thread, so the same photos give bit-identical models.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from flows.media.files import exif_focal_px
from flows.media.images import read_image, read_mask, resize, write_png
from flows.sfm.colmap import pycolmap

Progress = Callable[[str, int, int], None]

# Up to here all pairs are matched; beyond, neighbours in name order and those at distances of powers of two.
EXHAUSTIVE_LIMIT = 60
SEQUENTIAL_OVERLAP = 10
EXTRACTION_BATCH = 8
MATCHING_BATCH = 64
MAX_MODELS = 4
FROM_EXIF = "EXIF"
# In units of the photo's long side: fields of view from 110 down to 19 degrees; a focal length outside is a failure.
FOCAL_RANGE = (0.35, 3.0)
FOCAL_GUESSES = (0.5, 0.6, 0.75, 0.9, 1.1, 1.4, 1.8)
# More photos than this determine their focal length by themselves.
SWEEP_LIMIT = 12
# From so many photos on, the best guess is refined.
REFINABLE = 5


@dataclass(frozen=True)
class PoseSettings:
    """max_features: SIFT keypoints a photo. long_side_px: photos are shrunk to this first. minimum_share: below this
    share of registered photos (and below two) the estimate is an error. camera_model: COLMAP's name of the lens."""

    max_features: int = 4000
    long_side_px: int = 1600
    minimum_share: float = 0.5
    camera_model: str = "SIMPLE_RADIAL"


@dataclass
class Attempt:
    """The models of one mapping, the largest first."""

    name: str
    models: list[pycolmap.Reconstruction]

    @property
    def placed(self) -> int:
        """Photos in the largest model."""
        return self.models[0].num_reg_images() if self.models else 0

    @property
    def error_px(self) -> float:
        """Mean reprojection error of the largest model."""
        return self.models[0].compute_mean_reprojection_error() if self.models else math.inf

    def complete(self, count: int) -> bool:
        """Whether one model holds all photos."""
        return self.placed == count


def decoded(photos: Sequence[Path | str] | Sequence[np.ndarray]) -> bool:
    """Whether the photos are pixels and not files. Frames of a video are decoded as they are asked for, so only files,
    which come in a list, are looked at."""
    return not isinstance(photos, list | tuple) or isinstance(photos[0], np.ndarray)


class Mapper:
    """The steps of one estimate; files live in `folder`, images are called by their index."""

    def __init__(self, folder: Path, settings: PoseSettings, seed: int, progress: Progress) -> None:
        self.settings, self.progress, self.seed = settings, progress, seed % 2**31
        self.database, self.images, self.masks = folder / "database.db", folder / "images", folder / "masks"
        for path in (self.images, self.masks):
            path.mkdir(exist_ok=True)
        self.database.unlink(missing_ok=True)
        self.pair_list = folder / "pairs.txt"
        self.sizes: list[tuple[int, int]] = []
        self.scales: list[tuple[float, float]] = []  # working size / photo size, per axis
        self.shared = False
        self.focal_source = ""
        self.seconds: dict[str, float] = {}

    def extract(self, photos: Sequence[Path | str] | Sequence[np.ndarray], masks: Sequence[Path | None]) -> None:
        """Decode, shrink, and find SIFT keypoints; one camera for all where sizes and EXIF focal lengths agree."""
        start = time.perf_counter()
        files: Sequence[Any] = [] if decoded(photos) else photos
        focals: list[float | None] = [exif_focal_px(path) for path in files] or [None] * len(photos)
        for i, photo in enumerate(photos):
            image = photo if isinstance(photo, np.ndarray) else read_image(photo)[0]
            height, width = image.shape[:2]
            scale = min(1.0, self.settings.long_side_px / max(width, height))
            small = (max(1, round(width * scale)), max(1, round(height * scale)))
            write_png(self.images / image_name(i), resize(image, *small))
            if masks and masks[i] is not None:
                write_png(self.masks / f"{image_name(i)}.png", resize(read_mask(masks[i]), *small))  # type: ignore[arg-type]
            self.sizes.append((width, height))
            self.scales.append((small[0] / width, small[1] / height))
        self.shared = len(set(self.sizes)) == 1 and len(set(focals)) == 1
        self.focal_source = FROM_EXIF if all(focals) else "the photos themselves (self-calibration)"
        options = pycolmap.FeatureExtractionOptions()
        options.sift.max_num_features = self.settings.max_features
        reader = pycolmap.ImageReaderOptions(camera_model=self.settings.camera_model)
        if any(m is not None for m in masks):
            reader.mask_path = str(self.masks)
        mode = pycolmap.CameraMode.SINGLE if self.shared else pycolmap.CameraMode.PER_IMAGE
        names = [image_name(i) for i in range(len(photos))]
        # Imported first, in order: extraction alone numbers images as its threads finish, and mapping depends on that.
        pycolmap.Database.open(str(self.database)).close()
        pycolmap.import_images(self.database, self.images, mode, names, reader)
        self._set_focal_priors(focals)
        for first in range(0, len(names), EXTRACTION_BATCH):
            batch = names[first : first + EXTRACTION_BATCH]
            pycolmap.extract_features(
                self.database, self.images, batch, mode, reader, options, device=pycolmap.Device.cpu
            )
            self.progress("features", first + len(batch), len(photos))
        self.seconds["features"] = time.perf_counter() - start

    def _set_focal_priors(self, focals: list[float | None]) -> None:
        with pycolmap.Database.open(str(self.database)) as database:
            for image in database.read_all_images():
                focal, camera = focals[image_index(image.name)], database.read_camera(image.camera_id)
                if focal:
                    camera.focal_length = focal * self.scales[image_index(image.name)][0]
                    camera.has_prior_focal_length = True
                    database.update_camera(camera)

    def match(self) -> None:
        """Match pairs and verify them by two-view geometry."""
        start = time.perf_counter()
        pycolmap.set_random_seed(self.seed)  # the approximate nearest-neighbour index draws from it
        pairs = image_pairs(len(self.sizes))
        for first in range(0, len(pairs), MATCHING_BATCH):
            batch = pairs[first : first + MATCHING_BATCH]
            self._list_pairs(batch)
            pycolmap.match_image_pairs(
                self.database,
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(self.pair_list)),
                verification_options=self._verification(),
                device=pycolmap.Device.cpu,
            )
            self.progress("matching", first + len(batch), len(pairs))
        self.seconds["matching"] = time.perf_counter() - start

    def map_all(self) -> list[Attempt]:
        """Defaults first; where those left photos out, relaxed thresholds, for few photos with fixed focal lengths."""
        start = time.perf_counter()
        attempts = [Attempt("defaults", self._map(_options(self.seed, relaxed=False)))]
        if not attempts[0].complete(len(self.sizes)):
            if self.focal_source == FROM_EXIF or len(self.sizes) > SWEEP_LIMIT:
                attempts.append(Attempt("relaxed", self._map(_options(self.seed, relaxed=True))))
            else:
                attempts.append(self._sweep_focal())
        self.seconds["mapping"] = time.perf_counter() - start
        return attempts

    def _sweep_focal(self) -> Attempt:
        """Relaxed thresholds at each of FOCAL_GUESSES, held fixed: too few photos to refine a focal length show by
        their reprojection error which guess is nearest (two-view geometry is verified anew with each)."""
        options = _options(self.seed, relaxed=True)
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
        found: list[tuple[Attempt, float]] = []
        for guess in FOCAL_GUESSES:
            self._fix_focal(guess)
            found.append((Attempt(f"relaxed, focal length {guess:g} x long side", self._map(options)), guess))
        most = max(attempt.placed for attempt, _ in found)
        best, guess = min(((a, g) for a, g in found if a.placed == most), key=lambda f: f[0].error_px)
        if len(self.sizes) < REFINABLE or most == 0:
            return best
        self._fix_focal(guess)
        refined = Attempt(f"{best.name}, refined", self._map(_options(self.seed, relaxed=True)))
        return refined if refined.placed == most and refined.error_px < best.error_px else best

    def _fix_focal(self, guess: float) -> None:
        """Take the focal length (in units of the long side) for known, and verify the matched pairs anew with it."""
        with pycolmap.Database.open(str(self.database)) as database:
            for camera in database.read_all_cameras():
                camera.focal_length = guess * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                database.update_camera(camera)
            database.clear_two_view_geometries()
        self._list_pairs(image_pairs(len(self.sizes)))
        pycolmap.verify_matches(self.database, self.pair_list, self._verification())

    def _map(self, options: pycolmap.IncrementalPipelineOptions) -> list[pycolmap.Reconstruction]:
        """Models found, the one with most photos first."""
        registered = 2

        def count() -> None:
            nonlocal registered
            registered = min(registered + 1, len(self.sizes))
            self.progress("mapping", registered, len(self.sizes))

        output = self.database.parent / "sparse"
        output.mkdir(exist_ok=True)
        models = pycolmap.incremental_mapping(self.database, self.images, output, options, next_image_callback=count)
        return sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))

    def _verification(self) -> pycolmap.TwoViewGeometryOptions:
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = self.seed
        return options

    def _list_pairs(self, pairs: list[tuple[int, int]]) -> None:
        self.pair_list.write_text("".join(f"{image_name(i)} {image_name(j)}\n" for i, j in pairs))


def _options(seed: int, relaxed: bool) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = 2
    options.max_num_models = MAX_MODELS
    options.min_focal_length_ratio = options.mapper.min_focal_length_ratio = FOCAL_RANGE[0]
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = FOCAL_RANGE[1]
    if relaxed:
        options.multiple_models = False
        options.mapper.init_min_num_inliers = 30
        options.mapper.init_min_tri_angle = 2.0
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.abs_pose_min_inlier_ratio = 0.1
    return options


def image_pairs(count: int) -> list[tuple[int, int]]:
    """Which photos are matched: all pairs, or for many photos neighbours and power-of-two distances in their order."""
    if count <= EXHAUSTIVE_LIMIT:
        return list(combinations(range(count), 2))
    jumps = set(range(1, SEQUENTIAL_OVERLAP + 1)) | {2**k for k in range(count.bit_length())}
    return [(i, i + jump) for i in range(count) for jump in sorted(jumps) if i + jump < count]


def image_name(index: int) -> str:
    return f"{index:06d}.png"


def image_index(name: str) -> int:
    return int(name.split(".")[0])
