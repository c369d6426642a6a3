"""The report: its numbers are the tables' numbers, it is self-contained, and a real browser shows it."""

from __future__ import annotations

import re
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cat3d_core.metrics.seeds import Mean
from flows.jobs.metric_table import metric_table
from flows.reporting.answer import answers
from flows.reporting.charts import Point, Series, chart, log_ticks, ticks
from flows.reporting.published import PUBLISHED
from flows.reporting.report import write_report
from flows.reporting.summary import paper_tables, summary_rows, timing_rows
from schemas.tables import TIMINGS, append_rows
from tests.flows.conftest import ROOT, SCENE, TINY, command, environment, prefect_url  # noqa: F401


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, prefect_url: str) -> Path:  # noqa: F811
    out = tmp_path_factory.mktemp("report")
    subprocess.run(command("run", SCENE, "--out", str(out), *TINY), cwd=ROOT, env=environment(), check=True)
    return out / "report.html"


def test_page_shows_the_tables_numbers_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text()
    row = summary_rows(page.parent)[0]
    assert f'<td class="first">{row["psnr_db"]:.2f}</td><td>{row["ssim"]:.3f}</td>' in text, "in the paper's layout"
    link = f'<a href="#{row["scene_id"]}/{row["run"]}">'
    assert f"<td>{link}{row['psnr_db']:.2f}</a>" in text, "one click from a number to its views"
    assert f"<td>{link}{row['ssim']:.3f}</a>" in text
    assert f'id="{row["scene_id"]}/{row["run"]}"' in text
    assert answers(summary_rows(page.parent))[0].sentence in text, "the answer stands on the page"
    assert text.index('class="answer"') < text.index('class="gallery"') < text.index("<table")
    originals = set(re.findall(r'<img id="([^"]+)"', text))
    assert set(re.findall(r'data-of="([^"]+)"', text)) <= originals, "every copy has its picture"
    loaded = re.findall(r'(?:src|href)="([^"]+)"', text)
    outside = [u for u in loaded if not u.startswith(("data:", "#")) and not (page.parent / u).exists()]
    assert not outside, outside


@pytest.fixture
def chromium(tmp_path: Path) -> list[str]:
    """The command of a headless browser; skips where none is installed."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("No Chromium on this machine; install the package chromium to run this test.")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
             "--disable-background-networking", "--disable-component-update"]  # fmt: skip
    return [browser, *flags, f"--user-data-dir={tmp_path}/profile"]


@pytest.mark.slow
def test_a_real_browser_shows_it(page: Path, tmp_path: Path, chromium: list[str]) -> None:
    shot = tmp_path / "shot.png"
    call = [*chromium, "--window-size=1000,3000", f"--screenshot={shot}", page.as_uri()]
    subprocess.run(call, check=True, capture_output=True, timeout=240)
    from flows.media.images import read_image

    picture, _ = read_image(shot)
    assert picture.shape == (3000, 1000, 3)
    # The heading and the table on top, pictures (many colours) further down.
    assert (picture[:400] < 100).any()
    colours = np.unique(picture[400:].reshape(-1, 3) // 16, axis=0)
    assert len(colours) > 200


@pytest.mark.slow
def test_sliders_and_wide_tables_work_in_a_real_browser(page: Path, tmp_path: Path, chromium: list[str]) -> None:
    script = """<script>
    for (const slider of document.querySelectorAll('input')) {
      slider.value = 20; slider.dispatchEvent(new Event('input'));
    }
    document.title = document.documentElement.scrollWidth + ' ' + innerWidth;
    </script>"""
    moved = tmp_path / "moved.html"
    moved.write_text(page.read_text().replace("</body>", script + "</body>"))
    call = [*chromium, "--window-size=700,900", "--dump-dom", moved.as_uri()]
    dom = subprocess.run(call, check=True, capture_output=True, text=True, timeout=240).stdout
    assert dom.count("clip-path: inset(0px 80% 0px 0px)") == dom.count('type="range"') > 0
    assert dom.count("left: 20%") == dom.count('type="range"')
    width, window = map(int, re.search(r"<title>(\d+) (\d+)</title>", dom).groups())
    assert width <= window, "tables scroll on their own, the page does not"


def test_an_identical_render_and_empty_columns_do_not_break_the_page(tmp_path: Path) -> None:
    row = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8,
           "psnr_db": float("inf"), "ssim": 1.0, "dataset": "llff", "method": "zipnerf", "split": "3"}  # fmt: skip
    append_rows(tmp_path / "metrics", metric_table(), [row], "a")
    text = write_report(tmp_path).read_text()
    assert ">inf</a>" in text
    assert "| inf | 1.000 | - | - |" in (tmp_path / "report.md").read_text()
    assert [p for p in PUBLISHED if p["dataset"] == "llff" and p["method"] == "CAT3D" and p["split"] == "3"] == [
        {"dataset": "llff", "method": "CAT3D", "split": "3", "psnr_db": 21.58, "ssim": 0.731, "lpips": 0.181}
    ]


def test_papers_layout_has_its_rows_apart_from_ours(tmp_path: Path) -> None:
    base = {"key": "k", "protocol": "google", "view": 0, "width": 64, "height": 48, "dataset": "llff", "lpips": 0.5,
            "lpips_backbone": "st-lpips-alex"}  # fmt: skip
    values = {("a", "3"): 20.0, ("b", "3"): 22.0, ("a", "all"): 30.0}
    for (scene, split), psnr in values.items():
        run = {"scene_id": scene, "run": f"v{split}-zipnerf", "method": "zipnerf", "split": split, "psnr_db": psnr}
        append_rows(tmp_path / "metrics", metric_table(), [base | run | {"ssim": psnr / 40}], f"{scene}{split}")
    [table] = paper_tables(summary_rows(tmp_path))
    assert table["splits"] == ["3", "all"]
    *published, ours = table["datasets"][0]["rows"]
    assert [p["method"] for p in published] == ["Zip-NeRF*", "ZeroNVS*", "ReconFusion", "CAT3D"]
    assert published[3]["cells"] == [{"psnr_db": Mean(21.58), "ssim": Mean(0.731), "lpips": Mean(0.181)}, None]
    assert ours["cells"][0] == {"psnr_db": Mean(21.0), "ssim": Mean(0.525), "lpips": Mean(0.5)}
    assert ours["what"] == "mean of 2 scenes · 64x48 · st-lpips-alex"
    lines = (write_report(tmp_path).parent / "report.md").read_text().splitlines()
    assert "| llff | *CAT3D* | *the paper's scenes* | *21.58 / 0.731 / 0.181* | *-* |" in lines
    assert (
        "| llff | zipnerf | mean of 2 scenes · 64x48 · st-lpips-alex | 21.00 / 0.525 / 0.500 | 30.00 / 0.750 / 0.500 |"
        in lines
    )


def test_a_table_says_how_sure_its_means_are_and_what_is_noise(tmp_path: Path) -> None:
    base = {"scene_id": "a", "key": "k", "protocol": "google", "view": 0, "width": 64, "height": 48, "dataset": "x",
            "split": "3"}  # fmt: skip
    psnr = {"best": [25.0, 25.2, 25.4], "close": [24.9, 25.1, 25.3], "far": [20.0, 20.2, 20.4]}
    for method, values in psnr.items():
        rows = [base | {"run": f"v3-{method}-s{s}", "method": method, "seed": s, "psnr_db": value, "ssim": 0.5}
                for s, value in enumerate(values)]  # fmt: skip
        append_rows(tmp_path / "metrics", metric_table(), rows, method)
    page = write_report(tmp_path).read_text()
    cells = {method: f"{sum(values) / 3:.2f} ± 0.12" for method, values in psnr.items()}
    assert f">{cells['best']}<" in page
    assert f">{cells['close']} ≈<" in page
    assert f">{cells['far']}<" in page
    assert f"| {cells['close']} ≈ / 0.500 ± 0.000 / - |" in (tmp_path / "report.md").read_text()


def test_charts_have_round_ticks_and_every_finite_point() -> None:
    assert ticks(0.13, 0.94) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(5.0, 5.0)[0] <= 5.0 <= ticks(5.0, 5.0)[-1]
    assert log_ticks(3.0, 70.0) == pytest.approx([2.0, 5.0, 10.0, 20.0, 50.0, 100.0])
    points = [Point(1.0, 2.0, "a & b"), Point(10.0, float("inf")), Point(0.0, 1.0), Point(20.0, 3.0)]
    svg = chart([Series("zip<nerf", points)], "s", "dB", log_x=True)
    circles = ElementTree.fromstring(svg).findall("circle")
    assert len(circles) == 2 + 1, "two points and the legend"
    assert circles[0].find("title").text == "a & b"
    assert chart([Series("", [Point(1.0, float("nan"))])], "s", "dB") is None


def test_sampling_ahead_counts_as_the_stage_that_found_its_views(tmp_path: Path) -> None:
    base = {"scene_id": "a", "run": "v3-cat3d", "method": "cat3d", "key": "k"}
    times = [("sample_ahead", 40.0), ("sample", 0.5), ("sample", 30.0)]
    for minute, (stage, seconds) in enumerate(times):
        at = datetime(2026, 1, 1, 0, minute, tzinfo=UTC)
        append_rows(
            tmp_path / "timings", TIMINGS, [base | {"stage": stage, "started_at": at, "seconds": seconds}], f"{minute}"
        )
        expected = (0.0, 40.5, 30.0)[minute]
        assert timing_rows(tmp_path)[0]["total"] == expected


def test_only_the_latest_execution_of_a_stage_counts(tmp_path: Path) -> None:
    base = {"scene_id": "a", "run": "v3-zipnerf", "key": "k", "stage": "reconstruct"}
    for minute, seconds in ((1, 50.0), (2, 70.0)):
        at = datetime(2026, 1, 1, 0, minute, tzinfo=UTC)
        append_rows(tmp_path / "timings", TIMINGS, [base | {"started_at": at, "seconds": seconds}], f"t{minute}")
    assert timing_rows(tmp_path)[0]["total"] == 70.0
