"""Sampling in rounds: some groups, a brief reconstruction, then the groups it knows least about, while that helps.

Where sampling everything costs less than finding that out, everything is sampled. What decides is a captured view held
out of the brief reconstructions: when another round of generated views no longer lowers its error, the rest of the plan
is not sampled. So each scene gets as many generated views as it needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import Reconstructor, Views
from cat3d_core.uncertainty import unseen
from cat3d_core.view_selection import evenly, pose_distance
from flows.generation.brief import brief_reconstruction, brief_render
from flows.generation.groups import StoredPlan
from flows.generation.hints import explained_views
from flows.generation.open import open_generator
from flows.generation.views import finished, in_window
from flows.jobs.access import read_cameras, read_images, read_masks, views_with_role
from flows.jobs.job import Job
from flows.media.images import resize, to_uint8
from schemas.decisions import chosen as decided
from schemas.decisions import skipped
from schemas.scene_store import SceneStore

#: Share of the plan's groups in a round, and the least gain in PSNR of the held-out view that is worth another one.
SHARE, GAIN_DB = 0.25, 0.1
#: A brief reconstruction in floating-point operations of a denoiser that take as long: on a CPU 11 s, in which the
#: shipped model does 660 GFLOP (64 evaluations, 240 GFLOP, take 4 s). Choosing takes three of them at least.
BRIEF_FLOPS, BRIEF_FIELDS = 6.6e11, 3
#: Longer side of the pictures whose rays say what the field knows, in pixels.
PROBE_SIDE = 16


class OneRound:
    """All groups of the plan at once. kept: numbers of the groups whose views are used. decisions: why."""

    def __init__(self, plan: StoredPlan) -> None:
        self.passes = plan.passes()
        self.kept = [g for items in self.passes for g in items]
        none = skipped("Sampled nothing: captured views cover the path.", "covered_path")
        self.decisions = [] if plan.needed else [none]

    def __iter__(self) -> Iterator[list[list[int]]]:
        yield self.passes


class Rounds(OneRound):
    """Passes of groups, a round at a time; the next round is chosen from what the store holds when it is asked for."""

    def __init__(self, job: Job, store: SceneStore, plan: StoredPlan, flops: float) -> None:
        """flops: of sampling all groups."""
        super().__init__(plan)
        self.job, self.store, self.plan, self.flops = job, store, plan, flops
        self.train = views_with_role(store, store.run(job.run), "train")

    def __iter__(self) -> Iterator[list[list[int]]]:
        if len(self.train) < 2 or not self.passes:
            if self.passes:
                self.decisions.append(decided("Sampled in one round: a single captured view cannot be held out."))
            yield self.passes
            return
        if (1 - SHARE) * self.flops < BRIEF_FIELDS * BRIEF_FLOPS:
            text = "Sampled in one round: all groups cost less than the brief reconstructions that choosing takes."
            self.decisions.append(decided(text))
            yield self.passes
            return
        *anchors, rest = self.passes
        size = math.ceil(SHARE * len(rest))
        chosen = [rest[i] for i in evenly(len(rest), size)]
        self.kept, before, number = [], self.held_out_psnr(self.brief([])), 0
        while chosen:
            yield [*anchors, chosen]
            number += 1
            sampled = [*self.kept, *(g for items in anchors for g in items), *chosen]
            brief = self.brief(sampled)
            after = self.held_out_psnr(brief)
            change = f"Round {number}: with {len(chosen)} more groups the held-out captured view went from "
            change += f"{before:.2f} dB to {after:.2f} dB"
            if after >= before:
                self.kept = sampled
            if after - before < GAIN_DB:
                used = "" if after >= before else "; its views are not used"
                self.decisions.append(decided(f"{change}, which is less than {GAIN_DB:g} dB more{used}."))
                break
            self.decisions.append(decided(f"{change}."))
            left = [g for g in rest if g not in self.kept]
            unknown = {g: self.unknown(brief, g) for g in left}
            chosen = sorted(sorted(left, key=lambda g: (-unknown[g], g))[:size])
            anchors, before = [], after
        count = sum(map(len, self.passes))
        text = f"{len(self.kept)} of {count} groups are used, chosen for this scene in {number} rounds."
        self.decisions.append(skipped(text, "rounds", groups=count - len(self.kept)))

    @property
    def held_out(self) -> int:
        """The training view in the middle of the others: the one the field has the best chance to know."""
        cameras = read_cameras(self.store.captured, self.train)
        return self.train[int(pose_distance(cameras, cameras, scale=1.0).sum(1).argmin())]

    def views(self, groups: list[int]) -> Views:
        """Captured training views but the held-out one, and the decoded views of the groups."""
        shown = [v for v in self.train if v != self.held_out]
        cameras, images = read_cameras(self.store.captured, shown), list(read_images(self.store.captured, shown))
        masks = read_masks(self.store, shown)
        run = self.store.run(self.job.run)
        generator, explained = open_generator(self.job), explained_views(self.job, run)
        windows = self.plan.plan.window.tolist()
        for view in (v for g in groups for v in self.plan.groups[g].targets):
            made = to_uint8(finished(self.job, generator, run, view, bool(explained[view]))[0])
            camera, image = in_window(self.plan.cameras[view], made, windows[view])
            cameras, images = Cameras.cat([cameras, camera]), [*images, image]
        if masks is not None:
            masks += [None] * (len(cameras) - len(shown))
        return Views.from_images(cameras, images, torch.arange(len(cameras)) < len(shown), masks)

    def brief(self, groups: list[int]) -> Reconstructor:
        """A brief reconstruction of the captured views but the held-out one, and of the views of the groups."""
        return brief_reconstruction(self.job, self.views(groups))

    def held_out_psnr(self, brief: Reconstructor) -> float:
        """PSNR in dB of the held-out captured view, inside its mask if it has one, as `brief_render` shows it."""
        camera = read_cameras(self.store.captured, [self.held_out])
        image = brief_render(brief, camera, 0).image.cpu()
        truth = resize(self.store.captured.read_image("image", self.held_out), image.shape[1], image.shape[0])
        error = (image - torch.from_numpy(truth) / 255).square().mean(-1)
        masks = read_masks(self.store, [self.held_out])
        if masks is not None and masks[0] is not None:
            inside = resize(masks[0].numpy().astype(np.uint8) * 255, image.shape[1], image.shape[0]) >= 128
            error = error[torch.from_numpy(inside)] if inside.any() else error
        return -10 * math.log10(float(error.mean()) + 1e-10)

    def unknown(self, brief: Reconstructor, group: int) -> float:
        """In [0, 1]: how uncertain the reconstruction is of the group's middle view, or how much of it no view has
        seen."""
        targets = self.plan.groups[group].targets
        camera = self.plan.cameras[[targets[len(targets) // 2]]].resize(PROBE_SIDE, PROBE_SIDE)
        rays = image_rays(camera, 0)
        ends = rays.origins + brief.render(camera, 0).depth.cpu().reshape(-1, 1) * rays.directions
        known = [v for g in self.kept for v in self.plan.groups[g].targets]
        cameras = Cameras.cat([read_cameras(self.store.captured, self.train), self.plan.cameras[known]])
        away = unseen(ends.double(), cameras).float()
        uncertain = brief.uncertainty(camera, 0)
        return float(away.mean() if uncertain is None else torch.maximum(uncertain.cpu().flatten(), away).mean())
