"""The scene store: what goes in comes out, what isn't there or doesn't fit is said, records tell what is complete."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr

from schemas import arrays
from schemas.errors import MissingError, StoreError
from schemas.layout import LAYOUT, array_spec, done_path
from schemas.scene_store import SceneStore, StageRecord

STAGES = ("ingest", "poses", "plan", "encode", "sample", "decode", "reconstruct", "render", "evaluate")
V, N = 3, 4  # captured and generated views of the fixture
Record = Callable[..., StageRecord]


def test_every_array_of_the_layout_has_a_kind_a_stage_and_a_place() -> None:
    for spec in LAYOUT:
        assert spec.kind in arrays.KINDS
        assert array_spec(spec.path.replace("*", "x1")) is not None
        if spec.done is not None:
            marker = array_spec(spec.done.replace("*", "x1"))
            assert marker is not None
            assert (marker.kind, marker.stage) == ("key", spec.stage)
    assert done_path("runs/v3/renders/path/depth") == "runs/v3/renders/path/done"


def test_images_of_mixed_sizes_come_back_as_they_were(store: SceneStore) -> None:
    sizes = store.captured.read("size").tolist()
    assert [list(store.captured.read_image("image", v).shape) for v in range(V)] == [[h, w, 3] for w, h in sizes]
    padded = store.captured.read("image", [2])[0]
    assert padded.shape == (16, 20, 3)
    assert not padded[14:].any()
    assert not padded[:, 16:].any()
    assert store.captured.read("name").tolist() == ["a.jpg", "b.jpg", "ü.jpg"]


def test_the_store_is_plain_zarr_for_other_programs(store: SceneStore) -> None:
    group = zarr.open_group(str(store.root), mode="r")
    assert np.array_equal(group["captured/image"][:], store.captured.read("image"))
    assert group["runs/v3"].attrs["method"] == "cat3d"
    assert group["latents/captured"].chunks == (1, 4, 8, 8)
    assert not (store.root / ".zmetadata").exists()
    assert "consolidated_metadata" not in json.loads((store.root / "zarr.json").read_text())


@pytest.mark.parametrize("zeros", [True, False])
def test_every_written_chunk_is_a_file_even_when_it_is_all_zero(store: SceneStore, zeros: bool) -> None:
    generated = store.run("v3").generated
    generated.create_array("latent", (2, 1, 4, 4))
    generated.write_views("latent", np.full((1, 1, 4, 4), 0 if zeros else 1, np.float16), [1])
    assert sorted(p.name for p in (generated.folder / "latent").glob("c.*")) == ["c.1.0.0.0"]
    with pytest.raises(MissingError, match="View 0 of .*latent was never written"):
        generated.read("latent")


def test_an_array_of_the_same_shape_is_kept_and_another_replaced(store: SceneStore) -> None:
    generated = store.run("v3").generated
    before = generated.read("latent")
    generated.create_array("latent", before.shape)
    assert np.array_equal(generated.read("latent"), before)
    generated.create_array("latent", (N, 4, 8, 4))
    with pytest.raises(MissingError):
        generated.read("latent", [0])
    assert not list(store.root.rglob("*.partial"))


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (0, 3), (3, 0), (7, 2, 3)])
def test_arrays_of_any_shape_round_trip(
    store: SceneStore, shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "PARAMETER_CHUNK_BYTES", 50)  # several chunks
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    field = store.run("v3").field
    field.write("any", values)
    assert np.array_equal(field.read("any"), values)
    field.write("listed", values.astype(np.float64), "float64", "small")
    assert np.array_equal(field.read("listed"), values)


def test_float32_goes_into_float16_only_if_it_fits(store: SceneStore) -> None:
    generated = store.run("v3").generated
    generated.write_views("latent", np.full((1, 4, 8, 8), 0.1, np.float32), [0])
    assert generated.read("latent", [0])[0, 0, 0, 0] == np.float16(0.1)
    with pytest.raises(StoreError, match="256 of the values to write don't fit"):
        generated.write_views("latent", np.full((1, 4, 8, 8), 1e6, np.float32), [0])


@pytest.mark.parametrize(
    ("values", "views", "sentence"),
    [
        (np.zeros((1, 16, 16, 3), np.float32), [0], "holds uint8, but the values to write are float32"),
        (np.zeros((1, 16, 15, 3), np.uint8), [0], r"takes values of shape \(1, 16, 16, 3\)"),
        (np.zeros((1, 16, 16, 3), np.uint8), [N], f"View {N} is outside"),
        (np.zeros((1, 16, 16, 3), np.uint8), [-1], "View -1 is outside"),
        (np.zeros((2, 16, 16, 3), np.uint8), [1, 1], "name one view twice"),
    ],
)
def test_what_does_not_fit_is_refused(store: SceneStore, values: np.ndarray, views: list[int], sentence: str) -> None:
    generated = store.run("v3").generated
    before = generated.read("image")
    with pytest.raises(StoreError, match=sentence):
        generated.write_views("image", values, views)
    assert np.array_equal(generated.read("image"), before)


def test_the_wrong_dimensions_and_unknown_arrays_are_refused(store: SceneStore) -> None:
    with pytest.raises(StoreError, match="has the dimensions"):
        store.captured.create_array("image", (3, 16, 20, 4))
    with pytest.raises(ValueError, match="doesn't know 'captured/thing': say its dtype and kind"):
        store.captured.create_array("thing", (3,))
    with pytest.raises(StoreError, match="has no array 'depth_bounds' yet: run the stage 'poses'"):
        store.captured.read("depth_bounds")
    with pytest.raises(StoreError, match=r"no run 'v9' \(its runs: v3\)"):
        store.run("v9")
    with pytest.raises(StoreError, match=r"View 0 has the shape \(17, 20, 3\)"):
        store.captured.write_images("image", [np.zeros((17, 20, 3), np.uint8)], [0])


@pytest.mark.parametrize("name", ["..", "../x", "/etc", "a/b", "", ".hidden", "a\n", "x" * 101])
def test_no_name_leads_out_of_the_store(store: SceneStore, name: str) -> None:
    for use in (store.run, store.captured.read, store.captured.remove, store.section):
        with pytest.raises(StoreError, match="can't be a name"):
            use(name)
    with pytest.raises(StoreError, match="can't be a name"):
        store.run(name, create=True)


@pytest.mark.parametrize("value", [float("nan"), [1, float("-inf")], {"a": np.float32("inf")}])
def test_attributes_that_are_not_json_are_refused(store: SceneStore, value: object) -> None:
    with pytest.raises(StoreError, match="captured.scale.* is (nan|-inf|inf), which JSON can't hold"):
        store.captured.set_attrs(scale=value)
    with pytest.raises(StoreError, match="which can't be stored as JSON"):
        store.captured.set_attrs(scale=object())
    store.captured.set_attrs(similarity={"scale": np.float32(0.5), "rotation": np.eye(3)}, source=Path("a/b"))
    assert store.captured.attrs["similarity"]["rotation"][0] == [1.0, 0.0, 0.0]
    assert store.captured.attrs["source"] == "a/b"


def test_a_store_opened_for_reading_is_not_written(store: SceneStore, record: Record) -> None:
    reader = SceneStore.open(store.root)
    for change in (
        lambda: reader.captured.set_attrs(a=1),
        lambda: reader.captured.write("size", np.zeros((V, 2), np.int32)),
        lambda: reader.captured.write_views("image", np.zeros((1, 16, 20, 3), np.uint8), [0]),
        lambda: reader.captured.remove("image"),
        lambda: reader.complete("ingest", record("ingest")),
        lambda: reader.invalidate(["ingest"]),
        lambda: reader.run("new", create=True),
        lambda: reader.sweep(),
    ):
        with pytest.raises(StoreError, match="for reading only"):
            change()
    assert np.array_equal(reader.captured.read("image"), store.captured.read("image"))


def test_done_compares_keys_and_can_look_at_the_data(store: SceneStore, keys: list[str]) -> None:
    generated = store.run("v3").generated
    assert generated.done("done_latent", keys, ["latent"]).tolist() == [True] * N
    assert generated.done("done_latent", [keys[1], *keys[1:]]).tolist() == [False, True, True, True]
    (generated.folder / "done_latent" / "c.1.0").unlink()
    (generated.folder / "latent" / "c.2.0.0.0").write_bytes(b"")
    (generated.folder / "latent" / "c.3.0.0.0").unlink()
    assert generated.done("done_latent", keys).tolist() == [True, False, True, True]
    assert generated.done("done_latent", keys, ["latent"]).tolist() == [True, False, False, False]
    generated.mark_skipped("done_latent", [0])
    assert not generated.done("done_latent", keys)[0]


def test_records_are_read_back_and_taken_away_with_what_follows(store: SceneStore, record: Record) -> None:
    assert store.record("ingest") == record("ingest")
    assert store.record("evaluate", "v3") is None
    after_plan = STAGES[2:3] + STAGES[4:]
    assert store.invalidate(after_plan, "v3") == [
        "v3/plan",
        "v3/sample",
        "v3/decode",
        "v3/reconstruct",
        "v3/render",
    ]
    assert store.record("encode") is not None
    store.run("v6", create=True)
    store.complete("plan", record("plan"), "v6")
    assert store.invalidate(STAGES[1:]) == ["poses", "v6/plan", "encode"]
    assert store.record("ingest") is not None
    with pytest.raises(ValueError, match="say which run"):
        store.record("plan")
    with pytest.raises(ValueError, match="not of 'plan'"):
        store.complete("plan", record("sample"), "v3")
