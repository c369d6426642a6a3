"""What a run is reconstructed from: captured and generated views, without what the scene does not need of them."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Views
from flows.generation.brief import LEAST, shown_by_captured
from flows.jobs.access import read_cameras, read_images, views_with_role
from flows.jobs.job import Job
from flows.media.images import resize
from schemas.decisions import Decision, chosen, skipped
from schemas.scene_store import Run, SceneStore


def training_views(job: Job, store: SceneStore, run: Run) -> tuple[Views, list[Decision]]:
    """The run's training views: captured ones, and the generated ones where the run has them; what was decided."""
    train = views_with_role(store, run, "train")
    cameras = read_cameras(store.captured, train)
    images = read_images(store.captured, train)
    decisions = []
    if not job.generates:
        decisions.append(chosen("No views were generated: method zipnerf trains on captured views alone."))
    else:
        made = list(generated_views(run))
        if job.config.skip.detail:
            # It would be learned at the cost of what all views have in common (docs/guides/sweep.md).
            finest = float(cameras.intrinsics[:, 0, 0].max())
            whole, made = made, [no_finer(*view, finest) for view in made]
            reduced = [(a, b) for (_, a), (_, b) in zip(whole, made, strict=True) if a is not b]
            if reduced:
                share = sum(b.numel() for _, b in reduced) / sum(a.numel() for a, _ in reduced)
                text = f"{len(reduced)} of {len(made)} generated views were reduced to {share:.0%} of their pixels: "
                text += "no captured view shows finer detail."
                pixels = sum(a.numel() - b.numel() for a, b in reduced) // 3
                decisions.append(skipped(text, "detail", pixels=pixels))
        cameras = Cameras.cat([cameras, *(camera for camera, _ in made)])
        images += [image for _, image in made]
        if not made:
            text = "Trained on captured views alone, without the LPIPS loss: no view was generated."
            decisions.append(skipped(text, "covered_path"))
    captured = torch.arange(len(cameras)) < len(train)
    views, told = unseen_alone(job, Views.from_images(cameras, images, captured))
    return views, decisions + told


def generated_views(run: Run) -> Iterator[tuple[Cameras, torch.Tensor]]:
    """The generated views that are there: camera and (h, w, 3) uint8 image of the part that isn't padding."""
    shown = np.flatnonzero(run.generated.read("done_image").any(-1)).tolist()
    cameras, windows = read_cameras(run.plan, shown), run.plan.read("window", shown).tolist()
    for i, (view, (x0, y0, width, height)) in enumerate(zip(shown, windows, strict=True)):
        image = run.generated.read("image", [view])[0, y0 : y0 + height, x0 : x0 + width]
        yield cameras[i].crop(x0, y0, width, height), torch.from_numpy(np.ascontiguousarray(image))


def no_finer(camera: Cameras, image: torch.Tensor, focal: float) -> tuple[Cameras, torch.Tensor]:
    """A view (one camera, (h, w, 3) uint8), reduced where its focal length in pixels is longer than `focal`."""
    scale = focal / float(camera.intrinsics[0, 0, 0])
    if scale >= 1:
        return camera, image
    width, height = (max(1, round(side * scale)) for side in camera.size[0].tolist())
    return camera.resize(width, height), torch.from_numpy(resize(image.numpy(), width, height))


def unseen_alone(job: Job, views: Views) -> tuple[Views, list[Decision]]:
    """The views without those pixels of generated ones that two captured ones show as well, and what was decided."""
    captured = int(views.captured.sum())
    if not job.config.skip.seen or captured == len(views) or captured < LEAST:
        return views, []
    started = time.monotonic()
    shown = shown_by_captured(job, views)
    share = float(shown.sum() / views.size[~views.captured].prod(-1).sum())
    told = (
        f"{share:.0%} of the pixels of generated views were not trained on, since {LEAST} captured views show their "
        f"places as well: so says a field of those alone ({time.monotonic() - started:.0f} s). At least as large a "
        "share of the rays is theirs."
    )
    return views.only(~shown), [skipped(told, "seen", pixels=int(shown.sum()))]
