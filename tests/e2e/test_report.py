"""The report: its numbers are the tables' numbers, it is self-contained, and a real browser shows it."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from flows.published import PUBLISHED
from flows.report import summary_rows, write_report
from schemas.tables import METRICS, TIMINGS, append_rows
from tests.flows.conftest import ROOT, SCENE, TINY, command, environment, prefect_url  # noqa: F401


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, prefect_url: str) -> Path:  # noqa: F811
    out = tmp_path_factory.mktemp("report")
    subprocess.run(command("run", SCENE, "--out", str(out), *TINY), cwd=ROOT, env=environment(), check=True)
    return out / "report.html"


def test_page_shows_the_tables_numbers_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text()
    row = summary_rows(page.parent)[0]
    assert f"<td>{row['psnr_db']:.2f}</td>" in text
    assert f"<td>{row['ssim']:.3f}</td>" in text
    loaded = re.findall(r'(?:src|href)="([^"]+)"', text)
    outside = [u for u in loaded if not u.startswith(("data:", "#")) and not (page.parent / u).exists()]
    assert not outside, outside


@pytest.mark.slow
def test_a_real_browser_shows_it(page: Path, tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("No Chromium on this machine; install the package chromium to run this test.")
    shot = tmp_path / "shot.png"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
             "--disable-background-networking", "--disable-component-update"]  # fmt: skip
    subprocess.run(
        [browser, *flags, f"--user-data-dir={tmp_path}/profile", "--window-size=1000,2000", f"--screenshot={shot}",
         page.as_uri()], check=True, capture_output=True, timeout=240,
    )  # fmt: skip
    from flows.images import read_image

    picture, _ = read_image(shot)
    assert picture.shape == (2000, 1000, 3)
    # The heading and the table on top, pictures (many colours) further down.
    assert (picture[:400] < 100).any()
    colours = np.unique(picture[400:].reshape(-1, 3) // 16, axis=0)
    assert len(colours) > 200


def test_an_identical_render_and_empty_columns_do_not_break_the_page(tmp_path: Path) -> None:
    row = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8,
           "psnr_db": float("inf"), "ssim": 1.0, "dataset": "llff", "method": "zipnerf", "split": "3"}  # fmt: skip
    append_rows(tmp_path / "metrics", METRICS, [row], "a")
    text = write_report(tmp_path).read_text()
    assert "<td>inf</td>" in text
    assert (tmp_path / "report.md").read_text().count("\n") == 3
    assert [p for p in PUBLISHED if p["dataset"] == "llff" and p["method"] == "CAT3D" and p["split"] == "3"] == [
        {"dataset": "llff", "method": "CAT3D", "split": "3", "psnr_db": 21.58, "ssim": 0.731, "lpips": 0.181}
    ]


def test_only_the_latest_execution_of_a_stage_counts(tmp_path: Path) -> None:
    from datetime import UTC, datetime

    from flows.report import timing_rows

    base = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "stage": "reconstruct"}
    for minute, seconds in ((1, 50.0), (2, 70.0)):
        at = datetime(2026, 1, 1, 0, minute, tzinfo=UTC)
        append_rows(tmp_path / "timings", TIMINGS, [base | {"started_at": at, "seconds": seconds}], f"t{minute}")
    assert timing_rows(tmp_path)[0]["total"] == 70.0
