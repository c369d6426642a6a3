"""`cat3d inspect`: what it tells about a store is what is there."""

from __future__ import annotations

import json
import multiprocessing as mp
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from flows.pipeline.keys import downstream
from flows.reporting.inspect import inspect_store, stale_stages
from flows.reporting.inspect_text import as_text
from schemas.errors import StoreError
from schemas.scene_store import SceneStore, StageRecord

VIEWS, KEY = 4, "1" * 64
STAGES = [(None, "ingest"), (None, "poses"), (None, "encode"), ("v3", "plan"), ("v3", "sample"), ("v3", "decode")]


def complete(store: SceneStore, stage: str, run: str | None) -> None:
    time = "2026-01-01T00:00:00.000000+00:00"
    record = StageRecord(stage=stage, key=f"{stage}-key", started_at=time, finished_at=time, seconds=2.0)
    store.complete(stage, record, run)


@pytest.fixture
def store(tmp_path: Path) -> SceneStore:
    """Three photos of two sizes, a run whose four views are sampled and half decoded."""
    store = SceneStore.create(tmp_path / "scene.zarr", "fox", "nerfstudio", {"cat3d": "0.1"})
    captured = store.captured
    captured.create_array("image", (3, 40, 60, 3))
    captured.write_images("image", [np.full((height, 60, 3), 7, np.uint8) for height in (40, 40, 20)], range(3))
    captured.write("size", np.array([[60, 40], [60, 40], [60, 20]], np.int32))
    captured.write("intrinsics", np.tile(np.array([[30.0, 0, 30], [0, 30, 20], [0, 0, 1]]), (3, 1, 1)))
    world_from_camera = np.tile(np.eye(4), (3, 1, 1))
    world_from_camera[:, 0, 3] = [0, 1, 4]
    captured.write("world_from_camera", world_from_camera)
    generated = store.run("v3", create=True).generated
    for name, shape in (("latent", (VIEWS, 4, 8, 8)), ("image", (VIEWS, 16, 16, 3))):
        generated.create_array(name, shape)
        generated.create_array(f"done_{name}", (VIEWS, 32))
    generated.write_views("latent", np.ones((VIEWS, 4, 8, 8), np.float16), range(VIEWS))
    generated.mark_done("done_latent", [KEY] * VIEWS, range(VIEWS))
    generated.write_views("image", np.ones((2, 16, 16, 3), np.uint8), [0, 2])
    generated.mark_done("done_image", [KEY] * 2, [0, 2])
    for run, stage in STAGES[:-1]:
        complete(store, stage, run)
    return store


def test_the_report_says_what_is_there(store: SceneStore) -> None:
    report = inspect_store(store.root, verify_chunks=True)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["ok"]
    assert report["problems"] == []
    rows = {row["path"]: row for row in report["arrays"]}
    image, latent = rows["captured/image"], rows["runs/v3/generated/latent"]
    assert (image["shape"], image["dtype"], image["chunks"]) == ([3, 40, 60, 3], "uint8", [1, 40, 60, 3])
    assert image["codecs"] == ["zstd+bitshuffle", "crc32c"]
    assert image["compression_ratio"] > 10
    assert latent["bytes"] == VIEWS * 4 * 8 * 8 * 2
    assert latent["bytes_stored"] == latent["bytes"] + 4 * VIEWS  # a crc32c each
    assert (rows["runs/v3/generated/image"]["chunks_stored"], rows["runs/v3/generated/image"]["chunks_total"]) == (2, 4)
    stages = {(row["run"], row["stage"]): row for row in report["stages"]}
    assert all(stages[stage]["complete"] for stage in STAGES[:-1])
    assert not stages["v3", "decode"]["complete"]
    assert (stages["v3", "decode"]["views_done"], stages["v3", "decode"]["views_total"]) == (2, 4)
    assert (stages["v3", "sample"]["views_done"], stages["v3", "sample"]["seconds"]) == (4, 2.0)


def test_the_cameras_are_summed_up(store: SceneStore) -> None:
    cameras = inspect_store(store.root)["cameras"]
    assert list(cameras) == ["captured"]
    summary = cameras["captured"]
    assert summary["count"] == 3
    assert summary["sizes"] == {"60x40": 2, "60x20": 1}
    assert summary["focal_px"] == [30.0, 30.0]
    assert summary["fov_degrees"]["horizontal"] == pytest.approx([90.0, 90.0])
    assert summary["baseline_largest"] == 4.0
    assert summary["baseline_to_nearest"] == [1.0, 3.0]
    assert (summary["extent_min"], summary["extent_max"]) == ([0.0, 0.0, 0.0], [4.0, 0.0, 0.0])


def test_a_changed_key_makes_its_stage_and_those_after_it_stale(store: SceneStore) -> None:
    expected = {(run, stage): {f"{stage}-key"} for run, stage in STAGES}
    assert stale_stages(store, expected) == {}
    shared = {**expected, (None, "encode"): {"another run's encoder", "encode-key"}}
    assert stale_stages(store, shared) == {}
    changed = {**expected, ("v3", "plan"): {"new"}}
    assert list(stale_stages(store, changed)) == [("v3", "plan"), ("v3", "sample")]
    changed = {**expected, (None, "poses"): {"new"}}
    stale = stale_stages(store, changed)
    assert list(stale) == [(None, "poses"), (None, "encode"), ("v3", "plan"), ("v3", "sample")]
    assert stale["v3", "sample"] == "plan and encode before it is out of date"
    rows = inspect_store(store.root, expected=changed)["stages"]
    assert {(row["run"], row["stage"]) for row in rows if row["stale_because"]} == set(stale)


def test_damage_is_in_the_report(store: SceneStore) -> None:
    folder = store.root / "runs" / "v3" / "generated"
    (folder / "latent" / "c.1.0.0.0").write_bytes(b"xx")
    (folder / "latent" / "c.2.0.0.0").unlink()
    (folder / "latent" / "c.3.0.0.0.77.partial").write_bytes(b"")
    (store.root / "captured" / "size" / "zarr.json").write_text("{")
    complete(store, "decode", "v3")
    report = inspect_store(store.root)
    assert report["ok"]  # nothing was read
    assert [p["kind"] for p in report["problems"]] == ["orphan"]
    assert "damaged" in report["cameras"]["captured"]["error"]
    report = inspect_store(store.root, verify_chunks=True)
    assert not report["ok"]
    assert [(p["kind"], p["path"].split("/")[-1], p["chunk"], p["run"]) for p in report["problems"]] == [
        ("corrupted", "size", None, None),
        ("missing", "done_image", [1, 0], "v3"),
        ("missing", "done_image", [3, 0], "v3"),
        ("missing", "image", [1, 0, 0, 0], "v3"),
        ("missing", "image", [3, 0, 0, 0], "v3"),
        ("corrupted", "latent", [1, 0, 0, 0], "v3"),
        ("missing", "latent", [2, 0, 0, 0], "v3"),
        ("orphan", "c.3.0.0.0.77.partial", None, "v3"),
    ]


def test_the_text_names_every_array_stage_and_problem(store: SceneStore) -> None:
    (store.root / "runs/v3/generated/latent/c.1.0.0.0").write_bytes(b"xx")
    report = inspect_store(store.root, verify_chunks=True, expected={(None, "ingest"): {"new"}})
    console = Console(width=200, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(as_text(report))
    text = console.export_text()
    for part in (
        "scene fox of nerfstudio",
        "captured/",
        "world_from_camera",
        "3x40x60x3",
        "2/4",
        "stale: its",
        "2 of 60x40, 1 of 60x20 px",
        "corrupted: View 1 of",
        "damage was found",
    ):
        assert part in text, part


def test_an_empty_store_and_one_that_is_none(tmp_path: Path) -> None:
    SceneStore.create(tmp_path / "empty.zarr", "fox", "x", {})
    report = inspect_store(tmp_path / "empty.zarr", verify_chunks=True, expected={})
    assert (report["arrays"], report["cameras"], report["ok"]) == ([], {}, True)
    Console(file=open("/dev/null", "w")).print(as_text(report))  # noqa: SIM115
    with pytest.raises(StoreError, match="does not exist"):
        inspect_store(tmp_path / "none")


def _rewrite(path: str) -> None:
    store = SceneStore.open(path, "r+")
    for i in range(30):
        captured = store.captured
        captured.create_array("image", (3, 40, 60 + i % 2, 3))  # replaced each time
        captured.write_views("image", np.full((3, 40, 60 + i % 2, 3), i, np.uint8), range(3))
        store.run(f"run{i}", create=True)
        shutil.rmtree(store.root / "runs" / f"run{i}")


def test_a_store_is_inspected_while_it_is_rewritten(store: SceneStore) -> None:
    store.invalidate(downstream("ingest"))
    writer = mp.get_context("forkserver").Process(target=_rewrite, args=(str(store.root),))
    writer.start()
    looks = 0
    while writer.is_alive() or looks == 0:
        report = inspect_store(store.root, verify_chunks=True)
        assert {p["kind"] for p in report["problems"]} <= {"orphan"}
        looks += 1
    assert writer.exitcode == 0
    assert inspect_store(store.root, verify_chunks=True)["problems"] == []
