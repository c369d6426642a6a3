"""A small scene store with an array of every kind."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from schemas.scene_store import SceneStore, StageRecord

V, N, R = 3, 4, 2
KEYS = [f"{i + 1:064x}" for i in range(N)]


@pytest.fixture(scope="session")
def keys() -> list[str]:
    """Content keys of the generated views."""
    return KEYS


@pytest.fixture(scope="session")
def record() -> Callable[..., StageRecord]:
    return make_record


def make_record(stage: str, key: str = "k") -> StageRecord:
    time = "2026-01-01T00:00:00.000000+00:00"
    return StageRecord(stage=stage, key=key, started_at=time, finished_at=time, seconds=1.5, work={"views": 3})


def cameras(count: int) -> tuple[np.ndarray, np.ndarray]:
    """K (n,3,3) with a focal length of 30 px and cameras a unit apart along x."""
    intrinsics = np.tile(np.array([[30.0, 0, 10], [0, 30, 8], [0, 0, 1]]), (count, 1, 1))
    world_from_camera = np.tile(np.eye(4), (count, 1, 1))
    world_from_camera[:, 0, 3] = np.arange(count)
    return intrinsics, world_from_camera


@pytest.fixture
def store(template: Path, tmp_path: Path) -> SceneStore:
    """A store of one's own: every stage but evaluate complete, an array of every kind."""
    return SceneStore.open(shutil.copytree(template, tmp_path / "scene.zarr"), "r+")


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    store = SceneStore.create(tmp_path_factory.mktemp("template") / "scene.zarr", "fox", "nerfstudio", {"cat3d": "0.1"})
    captured = store.captured
    captured.create_array("image", (V, 16, 20, 3))
    captured.create_array("mask", (V, 16, 20))
    photos = [rng.integers(0, 256, (16 - i, 20 - 2 * i, 3), dtype=np.uint8) for i in range(V)]
    captured.write_images("image", photos, range(V))
    captured.write_images("mask", [photo[..., 0] for photo in photos], range(V))
    captured.write("size", np.array([photo.shape[1::-1] for photo in photos], np.int32))
    captured.write("name", ["a.jpg", "b.jpg", "ü.jpg"])
    for name, values in zip(("intrinsics", "world_from_camera"), cameras(V), strict=True):
        captured.write(name, values)
    captured.write("points", rng.normal(size=(50, 3)).astype(np.float32))
    store.latents.create_array("captured", (V, 4, 8, 8))
    store.latents.write_views("captured", rng.normal(size=(V, 4, 8, 8)).astype(np.float16), range(V))
    store.latents.create_array("done_captured", (V, 32))
    store.latents.mark_done("done_captured", KEYS[:V], range(V))
    run = store.run("v3", create=True)
    run.set_attrs(method="cat3d", split="3")
    run.write("role", np.array([1, 1, 2], np.uint8))
    for name, values in zip(("intrinsics", "world_from_camera"), cameras(N), strict=True):
        run.plan.write(name, values)
    run.plan.write("size", np.full((N, 2), 16, np.int32))
    run.plan.write("anchor", np.zeros(N, bool))
    run.generated.create_array("latent", (N, 4, 8, 8))
    run.generated.create_array("image", (N, 16, 16, 3))
    run.generated.create_array("done_latent", (N, 32))
    run.generated.create_array("done_image", (N, 32))
    run.generated.write_views("latent", rng.normal(size=(N, 4, 8, 8)).astype(np.float16), range(N))
    run.generated.write_views("image", rng.integers(0, 256, (N, 16, 16, 3), dtype=np.uint8), range(N))
    run.generated.mark_done("done_latent", KEYS, range(N))
    run.generated.mark_done("done_image", KEYS, range(N))
    run.field.write("grid", rng.normal(size=(2, 64, 2)).astype(np.float32))
    renders = run.renders("test")
    renders.create_array("image", (R, 16, 20, 3))
    renders.create_array("depth", (R, 16, 20))
    renders.create_array("done", (R, 32))
    renders.create_array("raymap", (R, 6, 8, 8), "float32", "raymap")
    renders.write_views("image", rng.integers(0, 256, (R, 16, 20, 3), dtype=np.uint8), range(R))
    renders.write_views("depth", rng.random((R, 16, 20)).astype(np.float32), range(R))
    renders.write_views("raymap", rng.random((R, 6, 8, 8)).astype(np.float32), range(R))
    renders.mark_done("done", KEYS[:R], range(R))
    for stage in ("ingest", "poses", "encode"):
        store.complete(stage, make_record(stage))
    for stage in ("plan", "sample", "decode", "reconstruct", "render"):
        store.complete(stage, make_record(stage), "v3")
    return store.root
