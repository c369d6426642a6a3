"""Stage evaluate: renders of held-out views against the photos, one row per view and protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cat3d_core.metrics import measures
from cat3d_core.metrics.clip import find_clip
from cat3d_core.metrics.measures import PERCEPTUAL, Comparison, Network
from cat3d_core.metrics.protocols import PROTOCOLS
from flows.jobs.access import read_cameras, read_images, read_similarity, views_with_role
from flows.jobs.job import Job, Outcome
from flows.jobs.metric_table import metric_table
from flows.jobs.stage import Stage, settings_of
from flows.media.clip_text import text_embedding
from flows.progress import meter
from flows.stages import render
from schemas.content_key import content_key
from schemas.decisions import Decision, chosen, skipped, warning
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.tables import append_rows

VERSION = 2
#: The metrics of this version; one that is added makes rows stale by its name.
MEASURED = ("psnr_db", "ssim", "lpips", "clip_score", "depth_abs_rel", "surface_chamfer")


def inputs(job: Job, keys: Mapping[str, str]) -> dict[str, Any]:
    """Of the renders only those of held-out views, so that a new path changes no number; which networks this machine
    has, which decides their columns; metrics that were added."""
    test = {"views": job.view_names("test"), "rendered": job.config.render.test_views}
    found: dict[str, Any] = {
        "render key": content_key(field=keys["reconstruct"], test=test, version=str(render.VERSION))
    }
    if job.capture().made_from is not None:
        found["path key"] = keys["render"]
    found |= {n.key: n.name() if _wanted(job, n) else None for n in measures.networks(measures.METRICS)}
    added = [metric.name for metric in measures.METRICS if metric.name not in MEASURED]
    return found | ({"metrics": added} if added else {})


def execute(job: Job, store: SceneStore, key: str) -> Outcome:
    """Write the rows of this run to `metrics/<scene>.<run>.parquet` in the output folder."""
    unknown = [p for p in job.config.evaluate.protocols if p not in PROTOCOLS]
    if unknown:
        raise ConfigError(f"evaluate.protocols: {unknown[0]} is not a protocol; those are {', '.join(PROTOCOLS)}.")
    run = store.run(job.run)
    test = views_with_role(store, run, "test")
    rows: list[dict[str, Any]] = []
    decisions = []
    if test and job.config.render.test_views:
        known = measures.networks(measures.METRICS)
        networks = {n.key: found for n in known if _wanted(job, n) and (found := n.load()) is not None}
        decisions += [warning(n.missing) for n in known if n.key not in networks]
        named = {n.column: networks[n.key].name for n in known if n.key in networks}
        renders, names = run.renders("test"), store.captured.read("name")
        depths, scale = job.capture().depths, np.float32(read_similarity(store).scale)
        cameras = read_cameras(renders)
        with meter(f"evaluate {job.scene_id} {job.run}", len(test)) as progress:
            for i, view in enumerate(test):
                what = _what(job, key) | {"view": view, "view_name": str(names[view])} | named
                geometry: dict[str, Any] = {}
                if depths is not None:
                    geometry = {n: torch.from_numpy(renders.read_image(n, i)) for n in ("depth", "opacity")}
                    geometry |= {"true_depth": torch.from_numpy(depths[view] * scale), "camera": cameras[i]}
                image, truth = renders.read_image("image", i), store.captured.read_image("image", view)
                mask = store.captured.read_image("mask", view) if "mask" in store.captured else None
                rows += view_rows(job.config.evaluate.protocols, image, truth, mask, what, networks, geometry)
                progress.advance()
    else:
        decisions.append(skipped("This run has no rendered held-out views: there is nothing to compare."))
    decisions += text_scores(job, store)
    append_rows(job.results_path / "metrics", metric_table(), rows, f"{job.scene_id}.{job.run}")
    pixels = int(store.captured.read("size", test).astype(np.int64).prod(1).sum()) if test else 0
    return Outcome({"views": len(test), "pixels": pixels}, decisions)


def text_scores(job: Job, store: SceneStore) -> list[Decision]:
    """Of a scene that a text made: how well the video's frames agree with the text and with its photo by CLIP, where
    there are weights for it."""
    run, made_from = store.run(job.run), store.captured.attrs.get("made_from")
    if not made_from or "path" not in run.section("renders"):
        return []
    if (tower := find_clip()) is None:
        return [warning("No CLIP weights (CAT3D_CLIP_WEIGHTS names a file of them): no scores of text and photo.")]
    frames = read_images(run.renders("path"), range(run.renders("path").shape("size")[0]))
    photo = store.captured.read_image("image", 0)
    embedded = torch.cat([tower(_image(np.asarray(frame))[None]) for frame in frames])
    by_photo = float((embedded @ tower(_image(photo)[None])[0]).mean())
    said = f"{len(embedded)} frames of the video by {tower.name}: CLIP score {by_photo:.3f} with the photo"
    text = text_embedding(made_from["text"])
    if text is None:
        return [chosen(f"{said}; none with the text (its tower and tokenizer, or transformers, are missing).")]
    return [chosen(f"{said}, {float((embedded @ text).mean()):.3f} with the text.")]


def _wanted(job: Job, network: Network) -> bool:
    return job.config.evaluate.lpips or network is not PERCEPTUAL


def _what(job: Job, key: str) -> dict[str, Any]:
    """The columns that say what a row is of."""
    return {
        "scene_id": job.scene_id, "dataset": job.dataset, "run": job.run, "method": job.label,
        "split": job.config.split, "seed": job.config.seed, "key": key, "code_version": str(VERSION),
    }  # fmt: skip


def _image(pixels: np.ndarray) -> Tensor:
    """(H, W, 3) uint8 -> (3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(pixels.astype(np.float32) / 255).permute(2, 0, 1)


def view_rows(
    protocols: tuple[str, ...], image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, what: dict[str, Any],
    networks: Mapping[str, Any], geometry: Mapping[str, Any],
) -> list[dict[str, Any]]:  # fmt: skip
    """A row for each protocol, from (H, W, 3) uint8: masked where the protocol defines masks and there is one (H, W).
    what: columns of all of them; geometry: what is known of depths, see `Comparison`."""
    height, width = image.shape[:2]
    masks = [mask if PROTOCOLS[p].mask != "none" else None for p in protocols]
    weights = [torch.from_numpy((m >= 128).astype(np.float32)) if m is not None else None for m in masks]
    views = [
        Comparison(p, _image(image), _image(truth), weight, networks=networks, **geometry)
        for p, weight in zip(protocols, weights, strict=True)
    ]
    return [
        what | numbers | {"protocol": v.protocol, "width": width, "height": height, "masked": v.mask is not None}
        for v, numbers in zip(views, measures.measure(views, measures.METRICS), strict=True)
    ]


STAGE = Stage("evaluate", execute, version=VERSION, reads=("render",), settings=settings_of("evaluate"), inputs=inputs)
