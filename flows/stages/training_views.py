"""What a run is reconstructed from: captured and generated views, without what the scene does not need of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import chain

import torch
from torch.nn import functional

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Views
from flows.generation.brief import LEAST, shown_by_captured
from flows.generation.photo_depths import photo_depths
from flows.generation.views import GeneratedView, generated_views
from flows.jobs.access import read_cameras, read_images, read_masks, views_with_role
from flows.jobs.job import Job
from flows.media.images import resize
from schemas.decisions import Decision, chosen, skipped
from schemas.scene_store import Run, SceneStore

#: Share of the pixels of generated views that captured ones show as well from which on none is trained on. Measured on
#: the procedural sweep: below 0.4 they gain 1 to 8 dB, from 0.5 on -0.5 to 0.1 (docs/log/2026-11-28_hints.md).
ENOUGH = 0.5
#: Up to so many captured views generated ones are always trained on: what two of so few show, they show badly.
FEW = 3

#: A view's z-depths (H, W), and the trust in them.
Known = tuple[torch.Tensor | None, torch.Tensor | None]


def enough(captured: int) -> float | None:
    """ENOUGH where that rule holds for so many captured views, else None."""
    return ENOUGH if captured > FEW else None


def training_views(job: Job, store: SceneStore, run: Run) -> tuple[Views, list[Decision]]:
    """The run's training views: captured ones, and the generated ones where the run has them; what was decided."""
    train = views_with_role(store, run, "train")
    cameras = read_cameras(store.captured, train)
    decisions, made = [], []
    if not job.generates:
        decisions.append(chosen("No views were generated: method zipnerf trains on captured views alone."))
    else:
        made = list(generated_views(run))
        if job.config.skip.detail:
            # It would be learned at the cost of what all views have in common (docs/guides/sweep.md).
            finest = float(cameras.intrinsics[:, 0, 0].max())
            whole, made = made, [no_finer(view, finest) for view in made]
            reduced = [(a.image, b.image) for a, b in zip(whole, made, strict=True) if a is not b]
            if reduced:
                share = sum(b.numel() for _, b in reduced) / sum(a.numel() for a, _ in reduced)
                text = f"{len(reduced)} of {len(made)} generated views were reduced to {share:.0%} of their pixels: "
                text += "no captured view shows finer detail."
                pixels = sum(a.numel() - b.numel() for a, b in reduced) // 3
                decisions.append(skipped(text, "detail", pixels=pixels))
        cameras = Cameras.cat([cameras, *(view.camera for view in made)])
        if not made:
            text = "Trained on captured views alone, without the LPIPS loss: no view was generated."
            decisions.append(skipped(text))
    captured = torch.arange(len(cameras)) < len(train)
    masks = read_masks(store, train)
    if masks is not None:
        masks += [None] * (len(cameras) - len(train))
        decisions.append(skipped("Pixels outside the masks of captured views were not trained on."))
    maps = {}
    if made and job.hinted:
        depths: list[Known] = [(None, None)] * len(train)
        if len(train) > 1:  # a single one's depth is a guess, and costs 0.1 dB
            depths = list(photo_depths(job, store, train))
            text = "Depths of the captured views go with them: the plane sweep's, where another view confirms them."
            decisions.append(chosen(text))
        maps = hint_maps(made, depths)
    images = chain(read_images(store.captured, train), (view.image for view in made))
    views = Views.from_images(cameras, images, captured, masks, **maps)
    kept, told = unseen(job, views)
    if told is None:
        return views, decisions
    if kept is not None:
        return views.only(kept), [*decisions, told]
    known, photos = slice(0, len(train)), read_images(store.captured, train)
    alone = Views.from_images(cameras[known], photos, captured[known], None if masks is None else masks[known])
    return alone, [*decisions, told]


def hint_maps(made: Sequence[GeneratedView], depths: Sequence[Known]) -> dict[str, list[torch.Tensor | None]]:
    """The trust in each pixel of generated views and the depths of captured ones, as `Views.from_images` takes them.

    Captured views are trusted wholly; depths are theirs, each with the trust in it, or none. Those of generated views
    are not used: no photo confirms them, and on captured scenes they cost 0.1 dB (docs/log/2026-11-29_depth.md)."""
    known: list[torch.Tensor | None] = [None] * len(depths)
    unknown: list[torch.Tensor | None] = [None] * len(made)
    return {
        "weights": known + [view.trust for view in made],
        "depths": [depth for depth, _ in depths] + unknown,
        "depth_weights": [trust for _, trust in depths] + unknown,
    }


def no_finer(view: GeneratedView, focal: float) -> GeneratedView:
    """A view, reduced where its focal length in pixels is longer than `focal`; the trust is that of the nearest
    pixel."""
    scale = focal / float(view.camera.intrinsics[0, 0, 0])
    if scale >= 1:
        return view
    width, height = (max(1, round(side * scale)) for side in view.camera.size[0].tolist())
    trust = view.trust
    if trust is not None:
        trust = functional.interpolate(trust[None, None], (height, width), mode="nearest-exact")[0, 0]
    image = torch.from_numpy(resize(view.image.numpy(), width, height))
    return GeneratedView(view.camera.resize(width, height), image, trust)


def unseen(job: Job, views: Views) -> tuple[torch.Tensor | None, Decision | None]:
    """Which pixels of the views (P,) bool are trained on: not those of generated ones that two captured ones show as
    well; None for captured views alone, where that is most of the pixels. And what was decided, if anything was."""
    captured = int(views.captured.sum())
    if not job.config.skip.seen or captured == len(views) or captured < LEAST:
        return None, None
    started = time.monotonic()
    shown = shown_by_captured(job, views)
    pixels = int(views.size[~views.captured].prod(-1).sum())
    share = float(shown.sum()) / pixels
    says = f"too, by a brief reconstruction of those views ({time.monotonic() - started:.0f} s)."
    bound = enough(captured)
    if bound is not None and share >= bound:
        text = f"No generated view was trained on: {LEAST} captured views show the places of {share:.0%} of their "
        text += f"pixels {says} The rest would cost more than it gives."
        return None, skipped(text, "seen", pixels=pixels)
    text = f"{share:.0%} of the pixels of generated views were not trained on: {LEAST} captured views show their "
    text += f"places {says} They get at least that share of the rays."
    return ~shown, skipped(text, "seen", pixels=int(shown.sum()))
