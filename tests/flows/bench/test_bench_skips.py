"""The benchmark of the skips: rows of real small runs, equal stages linked instead of made again, means and ratios."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flows.bench import skips
from flows.commands.bench import keep
from schemas.scene_store import SceneStore
from schemas.skip import SkipConfig
from tests.flows.stages.test_skips import SMALL, SOURCE
from tests.flows.workers.scene import random_model


def test_every_switch_is_measured_alone() -> None:
    alone = {name: switches for name, switches in skips.VARIANTS.items() if name.startswith("only ")}
    assert {next(n for n, on in switches.items() if on) for switches in alone.values()} == set(SkipConfig.model_fields)
    assert all(sum(switches.values()) == 1 for switches in alone.values())


def test_means_are_over_whole_sets_and_ratios_against_nothing_skipped() -> None:
    def row(scene: str, variant: str, seconds: float, psnr: float) -> dict:
        numbers = {"seconds": 2 * seconds, "cpu_seconds": seconds, "psnr_db": psnr, "lpips": None}
        return {"set": "s", "scene": scene, "variant": variant} | numbers

    measured = [row("a", "none", 40, 20), row("b", "none", 20, 30), row("a", "all", 10, 19), row("b", "all", 10, 30.5)]
    measured.append(row("a", "only plateau", 5, 18))
    found = {r["variant"]: r for r in skips.means(measured)}
    assert found.keys() == {"none", "all"}, "a variant that a scene lacks has no mean"
    change = skips.against_none(found["all"], measured)
    assert change["speed_up"] == change["speed_up_wall"] == 3
    assert change["psnr_change_db"] == pytest.approx(-0.25)
    assert change["lpips_change"] is None
    assert skips.against_none(measured[2], measured)["psnr_change_db"] == -1


@pytest.mark.slow
def test_variants_share_what_is_equal_and_go_on_where_they_stopped(tmp_path: Path) -> None:
    model = random_model(tmp_path / "tiny.safetensors")
    base = (
        "method=cat3d",
        f"sample.checkpoint={model}",
        "sample.steps=2",
        "plan.views=10",
        "render.path_views=2",
        SMALL,
    )
    scenes = [("procedural", SOURCE, ())]
    first = skips.rows(scenes, ("none", "only plateau", "default"), base, tmp_path / "out")
    store = SceneStore.open(tmp_path / "out/procedural_dtu_3.zarr")
    none, plateau = (store.run(f"v3-{name}") for name in ("none", "only-plateau"))
    views = (none.generated.folder / "latent/c.0.0.0.0", plateau.generated.folder / "latent/c.0.0.0.0")
    assert views[0].stat().st_ino == views[1].stat().st_ino, "the sampled views are linked"
    assert np.array_equal(none.generated.read("image"), plateau.generated.read("image"))
    assert store.record("reconstruct", "v3-only-plateau").key != store.record("reconstruct", "v3-none").key
    by = {(r["scene"], r["variant"]): r for r in first}
    assert by["procedural_dtu_3", "none"]["sample_seconds"] == by["procedural_dtu_3", "only plateau"]["sample_seconds"]
    assert by["mean", "none"]["speed_up"] == 1
    assert skips.rows(scenes, ("none", "only plateau", "default"), base, tmp_path / "out") == first
    assert (tmp_path / "out/report.html").exists()


def test_the_tables_go_between_the_markers_of_the_page(tmp_path: Path) -> None:
    counts = {"sample_seconds": 4.0, "reconstruct_seconds": 9.0, "evaluations": 64, "generated": 80, "steps": 500}
    measured = [
        {"set": "s", "scene": "a", "variant": v, "seconds": t, "cpu_seconds": t, "psnr_db": p, "lpips": None} | counts
        for v, t, p in (("none", 40.0, 20.0), ("default", 10.0, 20.25))
    ]
    rows = [row | skips.against_none(row, measured) for row in [*measured, *skips.means(measured)]]
    keep("skips", rows, tmp_path)
    page = tmp_path / "page.md"
    page.write_text(f"before\n{skips.START}\nold\n{skips.END}\nafter\n")
    for _ in range(2):
        skips.write_tables(page, tmp_path / "skips.parquet")
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "| default | 10.0 | 4.00x | 4.0 | 9.0 | 64 | 80 | 500 | 20.25 | +0.25 | - |" in text
    assert "| a | 40.0 | 10.0 | 4.00x | 20.00 | 20.25 | +0.25 | - | - |" in text
