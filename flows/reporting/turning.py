"""Scenes that one can turn in the report itself: splats and cameras, embedded, drawn by templates/scene.js."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import Render, normals_from_depth
from cat3d_core.splats import Gaussians
from cat3d_core.view_selection import evenly
from flows.errors import InputError
from flows.exports.preview import kept_preview
from flows.exports.splat_files import write_splat
from flows.exports.splats import splats_of
from flows.jobs.access import read_cameras
from flows.reconstruction.stored import read_reconstruction
from flows.reporting.content import ShownView, captured_views, planned_views, scene_points
from schemas.errors import StoreError
from schemas.scene_store import Run, SceneStore, Section

MOST = 20_000
"""Splats of a scene: 0.85 MB of the page."""
PAGE_BYTES = 12_000_000
"""What is embedded in a page altogether; further scenes are left out with a sentence."""
STEPS, SIDE = 100, 160
"""Splats are made of the stored renders with the longer side at most SIDE pixels, and refined in STEPS steps: some
seconds."""
COLOURS = {"train": (0.84, 0.15, 0.16), "test": (0.12, 0.47, 0.71), "generated": (0.17, 0.63, 0.17)}
CAMERAS, POINTS = 60, 3000
"""Cameras of each kind, and sparse points, that are drawn, at most."""


def turning_scene(store: SceneStore, run: Run, room: int) -> dict[str, Any] | None:
    """What the page embeds of a run, or a sentence on why it does not; None where there is no reconstruction yet.

    room: bytes that are left. Keys: "splats" (base64 of a .splat file), "cameras" (JSON, with the sparse points),
    "count" (of splats) and "bytes", or "left_out".
    """
    if store.record("reconstruct", run.name) is None:
        return None
    try:
        splats = _splats(store, run)
    except (InputError, StoreError) as error:
        return {"left_out": f"The scene cannot be turned here: {error}"}
    if splats is None:
        return None
    with TemporaryDirectory() as folder:
        file = Path(folder) / "scene.splat"
        write_splat(file, splats)
        encoded = base64.b64encode(file.read_bytes()).decode()
    points = scene_points(store)
    points = points[evenly(len(points), POINTS)]
    rows = camera_rows([*captured_views(store, run, pictures=False), *planned_views(run, pictures=False)])
    cameras = json.dumps({"cameras": rows, "points": np.round(points.astype(float), 3).tolist()})
    size = len(encoded) + len(cameras)
    if size > room:
        return {
            "left_out": f"The scene is left out: with its {size / 1e6:.1f} MB the page would be larger than "
            f"{PAGE_BYTES / 1e6:.0f} MB. `cat3d view` shows it."
        }
    return {"splats": encoded, "cameras": cameras, "count": len(splats), "bytes": size}


def _splats(store: SceneStore, run: Run) -> Gaussians | None:
    """Those that `cat3d view` has made, a reconstruction's own, or new ones of the stored renders."""
    kept = kept_preview(store, run)
    if kept is None and run.field.attrs.get("method") == "splats":
        kept = splats_of(read_reconstruction(store, run), [], read_cameras(store.captured), MOST)
    if kept is not None:
        shown = (kept.opacities * kept.scales.prod(1).pow(2 / 3)).argsort(descending=True, stable=True)[:MOST]
        return kept[shown]
    sections = [run.renders(kind) for kind in ("path", "test") if kind in run.section("renders")]
    parts = [stored_renders(section) for section in sections]
    renders = [render for made, _ in parts for render in made]
    if not renders:
        return None
    cameras = Cameras.cat([cameras for _, cameras in parts])
    return splats_of(read_reconstruction(store, run), renders, cameras, MOST, STEPS)


def stored_renders(section: Section) -> tuple[list[Render], Cameras]:
    """The renders of a section at most SIDE pixels large, with normals of their depths, and their cameras."""
    cameras = read_cameras(section).to(dtype=torch.float32)
    renders, resized = [], []
    for i in range(len(cameras)):
        step = max(1, -(-int(cameras.size[i].max()) // SIDE))
        arrays = [section.read_image(name, i)[::step, ::step] for name in ("image", "depth", "opacity")]
        image, depth, opacity = (torch.from_numpy(np.ascontiguousarray(array)).float() for array in arrays)
        camera = thinned(cameras[i], step)
        normals = normals_from_depth(depth, image_rays(camera, 0))
        renders.append(Render(image / 255, depth, depth, opacity, normals))
        resized.append(camera)
    return renders, Cameras.cat(resized)


def thinned(camera: Cameras, step: int) -> Cameras:
    """The camera of every step-th pixel of an image, from the first one on: what a kept pixel sees stays."""
    k = camera.intrinsics.clone()
    k[:, :2] /= step
    k[:, :2, 2] += 0.5 - 0.5 / step  # the centre of the first pixel is half a pixel in, before and after
    return Cameras(k, camera.world_from_camera, -(-camera.size // step))


def camera_rows(views: list[ShownView]) -> list[dict[str, Any]]:
    """pose (4 x 4), slopes (left, right, top, bottom edges at distance 1) and colour of views, evenly thinned."""
    rows = []
    for kind, colour in COLOURS.items():
        some = [view for view in views if view.kind == kind]
        for at in evenly(len(some), CAMERAS):
            camera = some[at].camera
            k, (width, height) = camera.intrinsics[0].double(), camera.size[0].tolist()
            across = [(edge - float(k[0, 2])) / float(k[0, 0]) for edge in (0, width)]
            down = [(edge - float(k[1, 2])) / float(k[1, 1]) for edge in (0, height)]
            pose = [[round(value, 5) for value in row] for row in camera.world_from_camera[0].tolist()]
            rows.append({"pose": pose, "slopes": [round(v, 5) for v in (*across, *down)], "colour": colour})
    return rows
