"""`cat3d bench`: the registry, the front, what is kept, the page, and one benchmark for real."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from flows.bench import sampler, size, store
from flows.bench.fronts import cell, drawn_panels, pareto_front, verdict
from flows.bench.page import read_benches, tables, worth_showing, write_page
from flows.bench.registry import BENCHES, Bench, Panel
from flows.bench.rows import MissingError
from flows.commands import bench as bench_command
from flows.errors import InputError
from schemas.errors import StoreError

POINTS = [
    {"s": 1.0, "e": 5.0, "name": "a"},
    {"s": 2.0, "e": 5.0, "name": "slower than a, not better"},
    {"s": 2.0, "e": 3.0, "name": "b", "default": True},
    {"s": 3.0, "e": 4.0, "name": "worse than b", "default": True},
    {"s": 4.0, "e": 1.0, "name": "c"},
    {"s": 4.0, "e": 1.0, "name": "the same as c"},
]
PANEL = Panel("A", "s", "e", ("name",))


def test_front_of_known_points():
    assert [row["name"] for row in pareto_front(POINTS, "s", "e")] == ["a", "b", "c"]
    higher = [row | {"e": -row["e"]} for row in POINTS]
    assert [row["name"] for row in pareto_front(higher, "s", "e", higher_is_better=True)] == ["a", "b", "c"]


def test_front_is_what_nothing_dominates():
    random = np.random.default_rng(0)
    rows = [{"s": float(s), "e": float(e)} for s, e in random.integers(0, 12, (80, 2))]
    front = {(r["s"], r["e"]) for r in pareto_front(rows, "s", "e")}
    points = {(r["s"], r["e"]) for r in rows}
    assert front == {p for p in points if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points)}


def test_verdict_names_what_beats_a_default():
    (drawn,) = drawn_panels(PANEL, POINTS)
    on, off = verdict(drawn)
    assert on.startswith("default b: on the front")
    assert "default worse than b: not on the front" in off
    assert "beaten by b" in off


def test_panels_part_by_columns_and_leave_out_what_has_no_number():
    rows = [{"scene": scene, "s": s, "e": 1.0, "name": ""} for scene in "xy" for s in (1.0, 2.0)]
    rows += [{"scene": "x", "s": 3.0, "name": "failed"}, {"scene": "y", "s": 3.0, "e": math.nan, "name": ""}]
    found = drawn_panels(replace(PANEL, each=("scene",)), rows)
    assert [(d.title, len(d.rows)) for d in found] == [("A: x", 2), ("A: y", 2)]
    assert drawn_panels(replace(PANEL, where=(("scene", "z"),)), rows) == []


def test_registry_has_every_module_and_name():
    names = {"sampler", "reconstruct", "kernels", "poses", "metrics", "plan", "store", "model"}
    assert names <= set(BENCHES)
    assert all(bench.summary and callable(bench.run) for bench in BENCHES.values())
    modules = {path.stem for path in Path(store.__file__).parent.glob("*.py") if "\ndef rows(" in path.read_text()}
    assert "plan" in modules
    assert modules <= set(BENCHES)


@pytest.mark.parametrize("name", ["poses", "scenes"])
def test_a_benchmark_without_its_data_says_so(name, tmp_path):
    with pytest.raises(MissingError, match="--data DIR"):
        BENCHES[name].run(True, None)
    with pytest.raises(MissingError, match="holds none of the scenes"):
        BENCHES[name].run(True, tmp_path)
    with pytest.raises(MissingError, match="--data"):
        bench_command.bench_command(name, True, None, tmp_path)


def test_unknown_names_and_folders(tmp_path):
    with pytest.raises(InputError, match="not a benchmark; there are sampler"):
        bench_command.bench_command("samplers", True, None, tmp_path)
    with pytest.raises(InputError, match="is not a folder"):
        bench_command.bench_command("plan", True, tmp_path / "none", tmp_path)


def test_store_bench_for_real(tmp_path, monkeypatch):
    """Through the command: the table is kept and read again, the page and its picture are written."""
    monkeypatch.setattr(store, "FORMATS", {kind: dict(list(f.items())[:2]) for kind, f in store.FORMATS.items()})
    bench = replace(BENCHES["store"], run=lambda quick, data: store.rows(2, 64, 1))
    monkeypatch.setitem(BENCHES, "store", bench)
    assert bench_command.bench_command("store", True, None, tmp_path) == 0
    table = pq.read_table(tmp_path / "benchmarks" / "store.parquet")
    assert {"bench", "quick", "machine", "date", "load", "versions", "codec", "error"} <= set(table.column_names)
    rows = read_benches(tmp_path / "benchmarks")["store"]
    assert len(rows) == 2 * 2 * len(store.CODECS)
    default = [(r["content"], r["format"]) for r in rows if r["default"]]  # one codec each is the store's own
    assert default == [("image", "uint8"), ("latent", "float16")]
    for row in rows:
        if row["codec"] == "raw":  # four bytes of checksum, nothing else
            assert row["bytes_per_view"] == pytest.approx(row["bytes_per_view"] / row["ratio"] + 4)
        # Rounding to 8 bits: uniform within a step; to half precision: 11 bits, so at most 2^-12 of values up to ~5.
        if row["format"] == "uint8":
            assert row["error"] == pytest.approx(1 / 255 / math.sqrt(12), rel=0.1)
        if row["format"] == "float16" and row["content"] == "latent":
            assert 1e-5 < row["error"] < 5 * 2**-12
    page = (tmp_path / "benchmarks.md").read_text()
    assert "## store" in page
    assert "default" in page
    assert (tmp_path / "benchmarks" / "store.png").read_bytes()[:4] == b"\x89PNG"


def test_photos_that_differ_in_size_are_cut_to_what_they_share(monkeypatch):
    monkeypatch.setattr(store, "CODECS", {"raw": None})
    photos = [np.full((20, 30, 3), 255, np.uint8), np.full((40, 16, 3), 255, np.uint8)]
    rows = store.photo_rows(photos, "photos", 24, 1)
    assert {row["shape"] for row in rows} == {"20x16x3"}
    assert next(row for row in rows if row["format"] == "uint8")["error"] == 0


def test_a_failed_benchmark_stops_no_other(tmp_path, monkeypatch, capsys):
    def breaks(quick, data):
        raise RuntimeError("broken on purpose")

    def lacks(quick, data):
        raise MissingError("No data here.")

    monkeypatch.setattr(bench_command, "BENCHES", {})
    for module in (bench_command.BENCHES, BENCHES):
        for name, run in (("model", breaks), ("poses", lacks), ("plan", lambda quick, data: [{"case": "x", "s": 1.0}])):
            monkeypatch.setitem(module, name, Bench("a test", run))
    assert bench_command.bench_command("all", True, None, tmp_path) == 1
    out = capsys.readouterr()
    assert "benchmark model failed" in out.err
    assert "left out. No data here." in " ".join(out.out.split())
    assert list(read_benches(tmp_path / "benchmarks")) == ["plan"]
    assert "## plan" in (tmp_path / "benchmarks.md").read_text()


def test_rows_with_different_columns_are_kept(tmp_path):
    rows = [{"case": "a", "n": 1, "x": 0.5}, {"case": "b", "n": 2.5, "ok": True}]
    bench_command.keep("plan", rows, tmp_path)
    assert read_benches(tmp_path)["plan"] == [{"case": "a", "n": 1.0, "x": 0.5}, {"case": "b", "n": 2.5, "ok": True}]


def test_a_damaged_table_is_named(tmp_path):
    (tmp_path / "plan.parquet").write_bytes(b"PAR1 but no more")
    with pytest.raises(StoreError, match=r"plan.parquet is damaged.*cat3d bench plan"):
        read_benches(tmp_path)
    with pytest.raises(StoreError):
        write_page(tmp_path / "benchmarks.md", tmp_path)


def test_tables_part_what_is_constant_from_what_varies():
    rows = [{"bench": "b", "threads": 1, "case": "x", "s": 1.0}, {"bench": "b", "threads": 1, "case": "y", "s": 2.0}]
    ((constants, columns, body),) = tables(rows)
    assert (constants, columns, body) == ({"threads": 1}, ["case", "s"], rows)
    ((constants, columns, _),) = tables(rows[:1])
    assert (constants, columns) == ({}, ["threads", "case", "s"])
    assert [cell(v) for v in (True, False, None, 0.000123456, 7, "a")] == ["yes", "", "", "0.0001235", "7", "a"]


def test_long_tables_show_fronts_and_defaults():
    rows = POINTS * 10
    assert worth_showing(rows, []) == rows
    shown = worth_showing(rows, drawn_panels(PANEL, rows))
    assert {row["name"] for row in shown} == {"a", "b", "c", "worse than b"}


def test_the_samplers_bench_measures_errors_that_fall_with_steps() -> None:
    rows = sampler.rows(steps=(4, 8), groups=2)
    chosen = [r for r in rows if (r["solver"], r["dtype"], r["interval"]) == ("unipc", "float32", "all")]
    errors = {(r["nodes"], r["steps"]): r["error"] for r in chosen}
    assert errors["log_snr", 8] < errors["log_snr", 4] < 0.5


def test_sizes_of_the_bench_of_sizes_can_be_drawn() -> None:
    for megapixels, (width, height) in size.SIZES.items():
        assert width % size.COARSE == height % size.COARSE == 0
        assert width * height == pytest.approx(megapixels * 1e6, rel=0.02)
