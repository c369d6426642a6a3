"""Stage render: the field -> images and depth of the held-out views and of a camera path, with a video."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor
from cat3d_core.trajectories import RECIPES, Shift, choose_recipe, scene_frame
from flows.jobs.access import read_cameras, views_with_role, write_cameras
from flows.jobs.job import Job, Outcome
from flows.jobs.needs import Needs
from flows.jobs.stage import Stage, settings_of
from flows.media import images
from flows.media.pictures import depth_picture
from flows.media.video import write_video
from flows.progress import Meter, meter
from flows.reconstruction.stored import read_reconstruction
from schemas.content_key import array_digest, content_key
from schemas.decisions import skipped
from schemas.scene_store import Run, SceneStore, Section

#: Raised when the same field and cameras give other pictures.
VERSION = 1
#: Depths of a video that its range of colours is found from, at most.
DEPTHS = 20_000_000


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """The held-out views."""
    return {"test": job.view_names("test")}


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write `renders/test` and `renders/path`: image, depth, opacity per view, each view recorded when it is done."""
    run = store.run(job.run)
    scene = read_reconstruction(store, run)
    settings = job.config.render
    test = views_with_role(store, run, "test") if settings.test_views else []
    captured = read_cameras(store.captured)
    jobs = [("test", captured[test], test)] if test else []
    decisions = [] if test else [skipped("No held-out views to render: this split has none.")]
    if settings.path != "none":
        path = camera_path(job, store, run)
        jobs.append(("path", path, list(range(len(path)))))
    total = sum(len(cameras) for _, cameras, _ in jobs)
    rendered, rays = 0, 0
    with meter(f"render {job.scene_id} {job.run}", total) as progress:
        for kind, cameras, views in jobs:
            made = render_views(run.renders(kind), scene, cameras, views, _field_key(job, store), progress)
            rendered, rays = rendered + len(made), rays + sum(made)
    if rendered < total:
        text = f"Skipped {total - rendered} of {total} renders: those of this field and these cameras are there."
        decisions.append(skipped(text, views=total - rendered))
    write_pictures(job, run, test)
    return Outcome({"views": rendered, "rays": rays}, decisions)


def _field_key(job: Job, store: SceneStore) -> str:
    """What all renders depend on beside their cameras, so that other settings leave them as they are."""
    record = store.record("reconstruct", job.run)
    return content_key(field=record.key if record else None, version=VERSION)


def render_views(
    section: Section, scene: Reconstructor, cameras: Cameras, views: list[int], key: str, progress: Meter
) -> list[int]:
    """Render the cameras that are not done yet under `key`; the number of rays cast for each that was rendered."""
    width, height = (int(s) for s in cameras.size.max(0).values)
    section.create_array("image", (len(cameras), height, width, 3))
    section.create_array("depth", (len(cameras), height, width))
    section.create_array("opacity", (len(cameras), height, width))
    section.create_array("done", (len(cameras), 32))
    write_cameras(section, cameras)
    section.write("view", np.array(views, np.int32))
    parts = zip(views, cameras.intrinsics, cameras.world_from_camera, cameras.size, strict=True)
    keys = [content_key(step=key, view=view, camera=[array_digest(part.numpy()) for part in c]) for view, *c in parts]
    done = section.done("done", keys, data=["image", "depth", "opacity"])
    rays = []
    for i in range(len(cameras)):
        if done[i]:
            progress.advance()
            continue
        out = scene.render(cameras, i)
        section.write_images("image", [images.to_uint8(out.image)], [i])
        for name, values in (("depth", out.depth), ("opacity", out.opacity)):
            padded = np.zeros((1, height, width), np.float32)
            padded[0, : values.shape[0], : values.shape[1]] = values.cpu().numpy()
            section.write_views(name, padded, [i])
        section.mark_done("done", [keys[i]], [i])
        rays.append(out.depth.numel())
        progress.advance()
    return rays


def camera_path(job: Job, store: SceneStore, run: Run) -> Cameras:
    """The cameras of the video: the curve of the recipe that suits the training views, unshifted, seen through the
    first training view's lens."""
    train = read_cameras(store.captured, views_with_role(store, run, "train"))
    points = torch.from_numpy(store.captured.read("points")).double() if "points" in store.captured else None
    frame = scene_frame(train, points)
    recipe, _ = choose_recipe(train, frame, points)
    poses = RECIPES[recipe].curve(frame, train, job.config.render.path_views, Shift())
    first = train[0]
    return Cameras(first.intrinsics.expand(len(poses), 3, 3), poses, first.size.expand(len(poses), 2))


def write_pictures(job: Job, run: Run, test: list[int]) -> None:
    """Write the renders as PNG files and the path as mp4 videos (colour, depth) into the run's folder of pictures."""
    job.pictures.mkdir(parents=True, exist_ok=True)
    if test:
        section = run.renders("test")
        for i, view in enumerate(test):
            images.write_png(job.pictures / f"test_{view:04d}.png", section.read_image("image", i))
            depth = section.read_image("depth", i)
            images.write_png(job.pictures / f"test_{view:04d}_depth.png", depth_picture(depth))
    if job.config.render.path == "none":
        return
    section = run.renders("path")
    frames = range(section.shape("image")[0])
    fps = job.config.render.fps
    write_video(job.pictures / "path.mp4", (section.read_image("image", i) for i in frames), fps)
    near, far = _depth_range(section)
    depths = (depth_picture(section.read_image("depth", i), near, far) for i in frames)
    write_video(job.pictures / "path_depth.mp4", depths, fps)


def _depth_range(section: Section) -> tuple[float, float]:
    """One range for the whole video, so that colours do not flicker."""
    frames, *size = section.shape("depth")
    step = max(1, math.isqrt(frames * math.prod(size) // DEPTHS))
    depth = np.stack([section.read("depth", [i])[0, ::step, ::step] for i in range(frames)])
    inside = depth[depth > 0]
    return tuple(np.quantile(inside, [0.01, 0.95]).tolist()) if inside.size else (0.1, 1.0)


STAGE = Stage(
    "render",
    execute,
    version=VERSION,
    reads=("reconstruct",),
    settings=settings_of("render"),
    inputs=inputs,
    needs=Needs(gpu=True, memory_gb=1.0),
)
