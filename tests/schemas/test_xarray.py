"""A store opens in what people use: xarray, its tree, dask. And a sweep of an older version is read, not redone."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest
import zarr

from schemas.layout import LAYOUT, SCHEMA_VERSION, describe
from schemas.scene_store import SceneStore
from schemas.verify import verify

xarray = pytest.importorskip("xarray")
FIXTURE = Path(__file__).parents[1] / "fixtures" / "sweep_of_0888913.tar.gz"


@pytest.fixture
def old_sweep(tmp_path: Path) -> Path:
    """A finished sweep of two runs (field alone; with generated views), made by commit 0888913."""
    with tarfile.open(FIXTURE) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def test_every_section_opens_as_a_dataset_with_names_units_and_coordinates(store: SceneStore) -> None:
    captured = xarray.open_zarr(store.folder, group="captured", consolidated=False)
    assert captured["image"].dims == ("view", "y", "x", "rgb")
    assert captured["image"].attrs["units"] == "sRGB, 0 to 255"
    assert list(captured.coords) == ["name"]
    assert captured["name"].values.tolist() == store.captured.read("name").tolist()
    np.testing.assert_array_equal(captured["image"].values, store.captured.read("image"))
    np.testing.assert_array_equal(captured["world_from_camera"].values, store.captured.read("world_from_camera"))


def test_the_whole_store_opens_as_a_tree_and_an_array_in_dask(old_sweep: Path) -> None:
    path = old_sweep / "out" / "scene.zarr"
    SceneStore.open(path, "r+")
    tree = xarray.open_datatree(path, engine="zarr", consolidated=False)
    assert {"/captured", "/latents", "/runs/v3-cat3d/plan", "/runs/v3-cat3d/generated"} <= set(tree.groups)
    assert tree["runs/v3-cat3d/renders/test"].coords["view"].dims == ("rendered_view",)
    assert list(tree["runs/v3-cat3d"].coords) == ["role"]
    import dask.array

    image = dask.array.from_zarr(str(path), component="runs/v3-cat3d/generated/image")
    np.testing.assert_array_equal(image.compute(), SceneStore.open(path).run("v3-cat3d").generated.read("image"))


def test_an_older_store_is_read_as_it_is_and_migrated_without_touching_its_data(old_sweep: Path) -> None:
    path = old_sweep / "out" / "scene.zarr"
    before = SceneStore.open(path)  # reading changes nothing
    assert before.attrs["schema_version"] == 1
    chunks = {p: p.read_bytes() for p in path.rglob("*") if p.is_file() and p.name != "zarr.json"}
    records = {stage: before.record(stage, "v3-cat3d") for stage in ("ingest", "sample", "reconstruct")}
    store = SceneStore.open(path, "r+")
    assert store.attrs["schema_version"] == SCHEMA_VERSION
    assert {p: p.read_bytes() for p in chunks} == chunks
    assert {stage: store.record(stage, "v3-cat3d") for stage in records} == records
    assert not [problem for problem in verify(store) if problem.kind != "orphan"]
    array = zarr.open_array(str(path / "captured" / "size"), mode="r")
    assert array.metadata.dimension_names == ("view", "wh")


def test_a_migrated_array_equals_one_that_is_made_today(old_sweep: Path) -> None:
    """Else the next run would throw its data away and make it again."""
    store = SceneStore.open(old_sweep / "out" / "scene.zarr", "r+")
    before = store.captured.read("image")
    store.captured.create_array("image", before.shape)
    np.testing.assert_array_equal(store.captured.read("image"), before)


def test_every_array_of_the_layout_names_its_dimensions_once_and_has_a_meaning() -> None:
    for spec in LAYOUT:
        assert spec.meaning
        if spec.dims is not None:
            names, attributes = describe(spec.path.replace("*", "x"), tuple(d.size or 2 for d in spec.dims))
            assert names == [d.name for d in spec.dims]
            assert len(set(names)) == len(names)
            assert attributes.get("units", "") == spec.unit
