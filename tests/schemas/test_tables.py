"""Tables: rows come back with their schema, writers don't meet, damage is named."""

from __future__ import annotations

import random
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.errors import StoreError
from schemas.tables import TIMINGS, append_rows, column, metrics_schema, read_rows

METRICS = metrics_schema(
    [
        column("psnr_db", pa.float64(), "peak signal-to-noise ratio", "dB"),
        column("ssim", pa.float64(), "structural similarity", "1"),
    ]
)


def metric(view: int, **values: Any) -> dict[str, Any]:
    row = {"scene_id": "fox", "key": "k", "protocol": "google", "view": view, "width": 64, "height": 48}
    return {**row, "psnr_db": 20.0 + view, **values}


def test_rows_come_back_with_types_and_meanings(tmp_path: Path) -> None:
    append_rows(tmp_path, METRICS, [metric(0), metric(1, psnr_db=float("inf"))], "fox-v3")
    append_rows(tmp_path, METRICS, [metric(2, ssim=0.5)], "fox-v6")
    table = read_rows(tmp_path)
    assert table.schema.names == METRICS.names
    assert table["psnr_db"].to_pylist() == [20.0, float("inf"), 22.0]
    assert table["ssim"].to_pylist() == [None, None, 0.5]
    assert table.schema.field("psnr_db").metadata[b"unit"] == b"dB"
    start = datetime(2026, 1, 1, tzinfo=UTC)
    row = {"scene_id": "fox", "key": "k", "stage": "render", "started_at": start, "seconds": 1.5, "views": 3}
    append_rows(tmp_path / "timings", TIMINGS, [row], "a")
    assert read_rows(tmp_path / "timings").to_pylist()[0]["started_at"] == start


@pytest.mark.parametrize("schema", [METRICS, TIMINGS])
def test_every_column_says_what_it_means(schema: pa.Schema) -> None:
    assert all(field.metadata[b"meaning"] for field in schema)
    assert {b"format", b"schema_version", b"row"} <= set(schema.metadata)


def test_the_same_name_replaces_and_leaves_no_temporary(tmp_path: Path) -> None:
    append_rows(tmp_path, METRICS, [metric(0), metric(1)], "fox")
    append_rows(tmp_path, METRICS, [metric(5)], "fox")
    assert read_rows(tmp_path)["view"].to_pylist() == [5]
    assert [p.name for p in tmp_path.iterdir()] == ["fox.parquet"]


def test_leftovers_of_a_killed_writer_are_passed_over(tmp_path: Path) -> None:
    append_rows(tmp_path, METRICS, [metric(0)], "fox")
    (tmp_path / ".fox.parquet.7f.partial").write_bytes(b"half")
    assert len(read_rows(tmp_path)) == 1
    assert len(pq.read_table(tmp_path)) == 1  # what other programs do


def test_an_older_file_lacks_columns_and_has_narrower_types(tmp_path: Path) -> None:
    append_rows(tmp_path, METRICS, [metric(0, ssim=0.5)], "new")
    pq.write_table(pa.table({"scene_id": ["old"], "psnr_db": pa.array([20], pa.int32())}), tmp_path / "old.parquet")
    table = read_rows(tmp_path)
    assert table["psnr_db"].to_pylist() == [20.0, 20.0]
    assert table["ssim"].to_pylist() == [0.5, None]


def test_an_empty_folder(tmp_path: Path) -> None:
    assert len(read_rows(tmp_path / "none", METRICS)) == 0
    with pytest.raises(StoreError, match="holds no tables"):
        read_rows(tmp_path)


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        (metric(0, pnsr=1), r"Row 0 .* has the columns \['pnsr'\]"),
        ({"scene_id": "fox"}, r"has no value for \['key', 'protocol', 'view', 'width', 'height'\]"),
        (metric(0, ssim="high"), "don't fit the schema"),
        (metric(2**40), "don't fit the schema"),
    ],
)
def test_rows_that_do_not_fit_are_refused(tmp_path: Path, row: dict[str, Any], sentence: str) -> None:
    with pytest.raises(StoreError, match=sentence):
        append_rows(tmp_path, METRICS, [row], "fox")
    assert not list(tmp_path.iterdir())
    with pytest.raises(StoreError, match="can't be a name"):
        append_rows(tmp_path, METRICS, [metric(0)], "../fox")


def test_tables_that_do_not_go_together(tmp_path: Path) -> None:
    append_rows(tmp_path, METRICS, [metric(0)], "fox")
    pq.write_table(pa.table({"view": ["text"]}), tmp_path / "other.parquet")
    with pytest.raises(StoreError, match="don't go together"):
        read_rows(tmp_path)


def test_no_damage_changes_a_row(tmp_path: Path) -> None:
    path = append_rows(tmp_path, METRICS, [metric(i, ssim=i / 7) for i in range(200)], "fox")
    good = path.read_bytes()
    rows = read_rows(tmp_path).to_pylist()
    for size in (0, 4, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:size])
        with pytest.raises(StoreError, match="fox.parquet is damaged"):
            read_rows(tmp_path)
    for position in random.Random(0).sample(range(len(good)), 300):  # pages, their headers and the footer
        bad = bytearray(good)
        bad[position] ^= 1 << (position % 8)
        path.write_bytes(bad)
        try:
            assert read_rows(tmp_path).to_pylist() == rows  # statistics, the meaning of a column, padding
        except StoreError as error:
            assert "fox.parquet is damaged" in str(error)  # noqa: PT017
