"""`cat3d inspect STORE ARRAY`: numbers in closed form, pictures of what can be looked at, and 80 columns."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from flows.errors import InputError
from flows.media.images import read_image
from flows.reporting.inspect import inspect_store
from flows.reporting.inspect_array import contact_sheet, inspect_array, statistics
from flows.reporting.inspect_text import as_text, one_array_text
from schemas.scene_store import SceneStore

DEPTH = np.array([[[1.0, 2.0, np.inf], [4.0, np.nan, 2.0]]], np.float32)


@pytest.fixture
def store(tmp_path: Path) -> SceneStore:
    store = SceneStore.create(tmp_path / "scene.zarr", "fox", "nerfstudio", {"cat3d": "0.1"})
    renders = store.run("v3-cat3d", create=True).renders("test")
    renders.create_array("depth", DEPTH.shape)
    renders.write_views("depth", DEPTH, [0])
    store.captured.write("size", np.array([[3, 2]], np.int32))
    store.captured.create_array("image", (4, 30, 40, 3))
    store.captured.write_views("image", np.full((3, 30, 40, 3), [200, 10, 10], np.uint8), [0, 1, 3])
    for i in range(20):
        store.run("v3-cat3d").field.write(f"levels_{i}_weight", np.zeros((2, 3), np.float32))
    return store


def printed(report: object, width: int = 80) -> str:
    file = io.StringIO()
    Console(file=file, width=width).print(report)
    return file.getvalue()


def test_statistics_leave_out_what_is_not_finite() -> None:
    numbers = statistics(DEPTH)
    assert numbers is not None
    assert (numbers["count"], numbers["not_finite"], numbers["least"], numbers["greatest"]) == (6, 2, 1.0, 4.0)
    assert numbers["mean"] == 2.25
    assert numbers["deviation"] == pytest.approx(np.std([1, 2, 4, 2]))
    assert sum(count for *_, count in numbers["histogram"]) == 4
    assert numbers["histogram"][0][0] == 1.0
    assert numbers["histogram"][-1][1] == 4.0


@pytest.mark.parametrize("values", [np.zeros(0), np.array(["a"])])
def test_text_and_nothing_have_no_statistics(values: np.ndarray) -> None:
    assert statistics(values) is None


def test_equal_values_and_none_finite() -> None:
    assert statistics(np.full(5, 3.0))["histogram"] == [[3.0, 3.0, 5]]  # type: ignore[index]
    assert statistics(np.full(5, np.nan)) == {"count": 5, "not_finite": 5}


def test_one_array_is_told_in_full(store: SceneStore) -> None:
    row = inspect_array(store, "runs/v3-cat3d/renders/test/depth")
    assert (row["dimensions"], row["unit"]) == (["rendered_view", "y", "x"], "scene unit")
    text = printed(one_array_text(row))
    assert "not finite   2 of 6" in text
    assert "1 to 4" in text
    assert "zstd+shuffle" in text
    assert inspect_array(store, "/captured/size")["values"] == ["3", "2"]


def test_an_unknown_array_is_refused_with_what_comes_close(store: SceneStore) -> None:
    with pytest.raises(InputError, match="no array 'depth'; those near it: runs/v3-cat3d/renders/test/depth"):
        inspect_array(store, "depth")
    with pytest.raises(InputError, match="holds no pictures; those that do: captured/image, runs/v3-cat3d"):
        contact_sheet(store, "captured/size", Path("nowhere.png"))


def test_a_contact_sheet_shows_each_view_and_black_where_there_is_none(store: SceneStore, tmp_path: Path) -> None:
    contact_sheet(store, "captured/image", tmp_path / "sheet.png")
    sheet = read_image(tmp_path / "sheet.png")[0]
    assert sheet[10, 10].tolist() == [200, 10, 10]
    assert sheet[sheet.shape[0] // 2 + 20, 20].tolist() == [0, 0, 0]
    contact_sheet(store, "runs/v3-cat3d/renders/test/depth", tmp_path / "depth.png")
    assert read_image(tmp_path / "depth.png")[0].std() > 10


def test_the_store_is_readable_in_80_columns_with_the_field_in_one_line(store: SceneStore) -> None:
    lines = printed(as_text(inspect_store(store.root))).splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)
    assert len([line for line in lines if "20 arrays" in line]) == 1
    assert not [line for line in lines if "levels_" in line]
