"""Damage on disk: every kind of it is found, by reading and by `verify`, and named by array and view."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
import zarr

from schemas import arrays
from schemas.documents import nodes, read_metadata
from schemas.errors import MissingError, StoreError
from schemas.scene_store import SceneStore
from schemas.verify import verify

#: One array of every kind in the fixture's store.
ARRAYS = {
    "image": "captured/image",
    "mask": "captured/mask",
    "latent": "runs/v3/generated/latent",
    "key": "runs/v3/generated/done_latent",
    "depth": "runs/v3/renders/test/depth",
    "raymap": "runs/v3/renders/test/raymap",
    "parameter": "runs/v3/field/grid",
    "small": "captured/world_from_camera",
    "text": "captured/name",
}


def _last_chunk(store: SceneStore, path: str) -> tuple[tuple[int, ...], Path]:
    array = arrays.open_array(store.folder / path, writable=False)
    chunk = list(arrays.chunk_coordinates(array))[-1]
    return chunk, arrays.chunk_file(store.folder / path, array, chunk)


def _problems(store: SceneStore) -> list[tuple[str, str, tuple[int, ...] | None]]:
    return [(p.kind, p.path, p.chunk) for p in verify(store)]


def test_a_good_store_has_no_problems(store: SceneStore) -> None:
    assert _problems(store) == []
    assert set(arrays.KINDS) == set(ARRAYS) - {"text"}


@pytest.mark.parametrize("path", ARRAYS.values(), ids=ARRAYS.keys())
def test_a_flipped_bit_is_found_wherever_it_is(store: SceneStore, path: str) -> None:
    chunk, file = _last_chunk(store, path)
    good = file.read_bytes()
    for position in sorted({0, 1, len(good) - 1, len(good) - 4, *random.Random(0).sample(range(len(good)), 20)}):
        bad = bytearray(good)
        bad[position] ^= 1 << (position % 8)
        file.write_bytes(bad)
        with pytest.raises(StoreError, match=f"{path} is damaged on disk .*: run the stage that makes it again"):
            arrays.read(store.folder / path)
    assert _problems(store) == [("corrupted", path, chunk)]


@pytest.mark.parametrize("path", ARRAYS.values(), ids=ARRAYS.keys())
def test_a_truncated_or_lengthened_chunk_is_found(store: SceneStore, path: str) -> None:
    chunk, file = _last_chunk(store, path)
    good = file.read_bytes()
    for bad in (b"", good[:1], good[:3], good[:4], good[:5], good[: len(good) // 2], good[:-1], good + b"\0", good * 2):
        file.write_bytes(bad)
        with pytest.raises(StoreError, match=f"{path} is damaged on disk"):
            arrays.read(store.folder / path)
    assert _problems(store) == [("corrupted", path, chunk)]


@pytest.mark.parametrize("path", ARRAYS.values(), ids=ARRAYS.keys())
def test_a_deleted_chunk_is_not_read_as_zeros(store: SceneStore, path: str) -> None:
    chunk, file = _last_chunk(store, path)
    file.unlink()
    with pytest.raises(MissingError, match=f"{path} was never written"):
        arrays.read(store.folder / path)
    assert ("missing", path, chunk) in _problems(store)


def test_damage_is_named_by_view_and_other_views_are_still_read(store: SceneStore) -> None:
    generated = store.run("v3").generated
    good = generated.read("latent")
    (generated.folder / "latent" / "c.2.0.0.0").write_bytes(b"")
    with pytest.raises(StoreError, match="View 2 of .*latent is damaged"):
        generated.read("latent")
    assert np.array_equal(generated.read("latent", [3, 0]), good[[3, 0]])
    generated.write_views("latent", good[2:3], [2])  # made again over the damage
    assert np.array_equal(generated.read("latent"), good)
    assert _problems(store) == []


def test_a_chunk_may_be_missing_where_its_stage_is_not_complete_or_its_view_left_out(store: SceneStore) -> None:
    generated = store.run("v3").generated
    for name in ("latent/c.1.0.0.0", "image/c.1.0.0.0", "done_latent/c.1.0"):
        (generated.folder / name).unlink()
    generated.mark_skipped("done_image", [1])
    assert _problems(store) == [
        ("missing", "runs/v3/generated/done_latent", (1, 0)),
        ("missing", "runs/v3/generated/latent", (1, 0, 0, 0)),
    ]
    store.invalidate(["sample", "decode", "reconstruct", "render"], "v3")
    assert _problems(store) == []
    (generated.folder / "latent" / "c.2.0.0.0").unlink()  # marked as done, so it should be there
    assert _problems(store) == [("missing", "runs/v3/generated/latent", (2, 0, 0, 0))]


def test_no_flipped_bit_of_any_metadata_changes_what_is_read(store: SceneStore) -> None:
    rng = random.Random(0)
    for path, _ in list(nodes(store.folder)):
        file = store.folder / path / "zarr.json"
        good = file.read_bytes()
        before = read_metadata(file.parent)
        for position in rng.sample(range(len(good)), 12):
            bad = bytearray(good)
            bad[position] ^= 1 << rng.randrange(8)
            file.write_bytes(bad)
            try:
                after = read_metadata(file.parent)
            except StoreError as error:
                assert f"{file} is damaged" in str(error)  # noqa: PT017
                continue
            # White space, or the name of the checksum, which then is one more attribute.
            assert {**after, "attributes": {}} == {**before, "attributes": {}}
            assert after["attributes"].items() >= before["attributes"].items()
        file.write_bytes(good)


@pytest.mark.parametrize("path", ["captured", "captured/image", "stages/poses", "runs/v3/generated/done_latent"])
def test_changed_metadata_is_found_by_verify(store: SceneStore, path: str) -> None:
    file = store.folder / path / "zarr.json"
    file.write_text(file.read_text().replace('"zarr_format": 3', '"zarr_format": 4'))
    assert ("corrupted", path, None) in _problems(store)


def test_a_damaged_record_is_named(store: SceneStore) -> None:
    file = store.folder / "stages" / "poses" / "zarr.json"
    file.write_text(file.read_text().replace('"seconds": 1.5', '"seconds": 2.5'))
    with pytest.raises(StoreError, match="poses.*checksum doesn't match"):
        store.record("poses")
    document = {"zarr_format": 3, "node_type": "group", "attributes": {"stage": "poses", "seconds": -1}}
    file.write_text(json.dumps(document))
    with pytest.raises(StoreError, match="record .*poses is damaged .*: remove it and run the stage again"):
        store.record("poses")
    assert _problems(store) == [("corrupted", "stages/poses", None)]
    store.invalidate(["poses", "plan", "encode", "sample", "decode", "reconstruct", "render"])
    assert store.record("poses") is None


def test_leftovers_are_reported_passed_over_and_swept(store: SceneStore) -> None:
    good = store.captured.read("image")
    (store.captured.folder / "image" / "c.0.0.0.7f.partial").write_bytes(b"half a chunk")
    trash = store.captured.folder / ".old.7f.partial"
    trash.mkdir()
    (trash / "c.0.7f.partial").write_bytes(b"")
    expected = ["captured/.old.7f.partial", "captured/image/c.0.0.0.7f.partial"]
    assert [(p.kind, p.path) for p in verify(store)] == [("orphan", path) for path in expected]
    assert np.array_equal(store.captured.read("image"), good)
    assert "old" not in " ".join(store.captured.names())
    store.sweep()
    assert _problems(store) == []


def test_stray_files_folders_and_unchecked_arrays_are_reported(store: SceneStore) -> None:
    (store.captured.folder / "image" / "c.9.0.0.0").write_bytes(b"")
    (store.captured.folder / "stray").mkdir()
    zarr.create_array(str(store.captured.folder / "foreign"), shape=(1,), dtype="f4")[:] = 1
    assert [(p.kind, p.path) for p in verify(store)] == [
        ("unchecked", "captured/foreign"),
        ("orphan", "captured/image/c.9.0.0.0"),
        ("orphan", "captured/stray"),
    ]
