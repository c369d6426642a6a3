"""Stage poses: cameras of the captured views in the scene frame; estimated by SfM only where none are given."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras, orthonormalize
from cat3d_core.normalization import Similarity, normalize_scene
from flows.jobs.access import write_cameras
from flows.jobs.job import Job, Outcome
from flows.jobs.stage import Stage, settings_of
from flows.progress import Meter, meter
from flows.readers.base import Capture
from flows.sfm.poses import PoseSettings, estimate_poses
from flows.stages.ingest import Ingested, in_chunks, ingest_view, write_captured
from schemas.decisions import Decision, chosen, skipped
from schemas.scene_store import SceneStore


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The given cameras and points."""
    return {"cameras": job.scene.digests["cameras"]}


def are_given(job: Job) -> bool:
    """Whether nothing is estimated, so that no randomness comes in."""
    return job.config.poses.estimate != "always" and job.scene.digests["cameras"]["poses"] is not None


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `world_from_camera` (scene frame), `registered`, points and depth bounds, and the similarity."""
    capture = job.capture()
    if job.config.poses.estimate == "always":
        masks = capture.masks if capture.upright else []  # they belong to the pixels as stored, the estimate does not
        capture = dataclasses.replace(
            capture,
            cameras=None,
            distortion=None,
            fisheye=None,
            points=None,
            depth_bounds=None,
            upright=True,
            masks=masks,
        )
    if capture.cameras is not None:
        decisions = [skipped("Skipped pose estimation: the cameras are given.")]
        cameras = _stored_cameras(store, capture.cameras)
        registered = np.ones(len(capture), bool)
        points, bounds = capture.points, capture.depth_bounds
    else:
        cameras, registered, points, decisions = _estimate(job, store, capture)
        bounds = None
    if job.config.poses.normalize:
        similarity = normalize_scene(cameras[np.flatnonzero(registered).tolist()], points, bounds)
        decisions.append(chosen(f"The scene's scale was set from {similarity.method}."))
    else:
        similarity = Similarity(1.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), "none")
    write_poses(store, cameras, registered, similarity, points, bounds)
    return Outcome({"views": int(registered.sum())}, decisions)


def _estimate(
    job: Job, store: SceneStore, capture: Capture
) -> tuple[Cameras, np.ndarray, torch.Tensor | None, list[Decision]]:
    """Cameras of all views by structure from motion; the stored images are undistorted with the lens that was found.

    Views that could not be placed get the first placed camera and registered = False.
    """
    settings = job.config.poses
    asked = PoseSettings(
        max_features=settings.max_features, minimum_share=settings.min_registered, camera_model=settings.camera_model
    )
    photos = capture.images if capture.images is not None else capture.paths
    meters: dict[str, Meter] = {}
    with contextlib.ExitStack() as stack:

        def on_progress(step: str, done: int, total: int) -> None:
            if step not in meters:
                meters[step] = stack.enter_context(meter(f"poses {job.scene_id}: {step}", total))
            meters[step].update(done)

        result = estimate_poses(photos, job.config.seed, on_progress=on_progress, masks=capture.masks, settings=asked)
    registered = np.zeros(len(capture), bool)
    registered[result.registered] = True
    row = {view: i for i, view in enumerate(result.registered)}

    def one(view: int) -> Ingested:
        i = row.get(view, 0)
        camera = result.cameras[i]
        lens = result.distortion[i] if result.distortion is not None and view in row else None
        if view not in row:  # an unplaced photo may have another size; its camera is a stand-in of the right shape
            camera = camera.resize(*capture.size(view))
        return ingest_view(capture, view, job.config.ingest, lens, camera)

    write_captured(store, capture, job, in_chunks(one, len(capture)))
    size = torch.from_numpy(store.captured.read("size").astype(np.int64))
    poses = torch.stack([result.cameras.world_from_camera[row.get(v, 0)] for v in range(len(capture))])
    intrinsics = torch.from_numpy(store.captured.read("intrinsics"))
    cameras = Cameras(intrinsics, orthonormalize(poses), size)
    points = result.points if len(result.points) else None
    return cameras, registered, points, [chosen(result.report.summary())]


def _stored_cameras(store: SceneStore, given: Cameras) -> Cameras:
    """The given poses with the intrinsics and sizes of the stored (undistorted, downscaled) images."""
    size = torch.from_numpy(store.captured.read("size").astype(np.int64))
    intrinsics = torch.from_numpy(store.captured.read("intrinsics"))
    return Cameras(intrinsics, orthonormalize(given.world_from_camera.double()), size)


def write_poses(
    store: SceneStore,
    cameras: Cameras,
    registered: np.ndarray,
    similarity: Similarity,
    points: torch.Tensor | None,
    depth_bounds: torch.Tensor | None,
) -> None:
    """Move everything into the scene frame and write it; cameras are in the data set's world."""
    captured = store.captured
    write_cameras(captured, similarity.cameras(cameras))
    captured.write("registered", registered, dtype="bool", kind="small")
    for name, values in (
        ("points", None if points is None else similarity.points(points.double()).float()),
        ("depth_bounds", None if depth_bounds is None else depth_bounds.double() * similarity.scale),
    ):
        if values is None:
            captured.remove(name)
        else:
            captured.write(name, values.numpy())
    captured.set_attrs(
        similarity={
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
            "method": similarity.method,
        }
    )


STAGE = Stage(
    "poses", execute, version=1, reads=("ingest",), settings=settings_of("poses", "seed"), inputs=inputs,
    seedless=are_given,
)  # fmt: skip
