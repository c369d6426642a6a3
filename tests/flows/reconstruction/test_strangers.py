"""What someone else adds works after one edit: a reconstructor in a package of theirs, a metric and a solver in a line.

The reconstructor is the one of docs/guides/own_reconstructor.md, as it stands there.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.diffusion import solvers
from cat3d_core.diffusion.sampler import SamplerConfig
from cat3d_core.metrics import measures
from cat3d_core.metrics.measures import Comparison, Metric
from flows.commands.results import compare
from flows.exports.source import open_source, render_views
from flows.jobs.access import read_cameras
from flows.jobs.job import Job
from flows.jobs.metric_table import metric_table
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import expected_steps, pending
from flows.reconstruction.open import GROUP
from flows.reconstruction.stored import read_reconstruction
from flows.reporting.report import write_report
from flows.reporting.summary import summary_rows
from schemas.scene_store import SceneStore
from schemas.tables import read_rows
from tests.flows.packages import install_guide
from tests.flows.workers.scene import run_stages

SOURCE = "procedural:dtu/3?views=9&width=32&height=24"
STAGES = ("ingest", "poses", "reconstruct", "render", "evaluate")


def job(out: Path, *settings: str) -> Job:
    texts = ["method=zipnerf", "render.path_views=2", "reconstruct.method=nearest_photo", *settings]
    return Request(SOURCE, out, ("3",), make_config({}, None, texts)).jobs()[0]


def brightness(view: Comparison) -> float:
    return float((view.image.mean() - view.truth.mean()).abs())


def test_a_strangers_reconstructor_and_metric_reach_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_guide(tmp_path / "site", monkeypatch, "own_reconstructor.md", GROUP)
    out = tmp_path / "out"
    one = job(out)
    run_stages(one, *STAGES)
    store = SceneStore.open(one.store_path)
    run = store.run(one.run)
    assert run.field.attrs["method"] == "nearest_photo"
    # A camera at a photo's place sees that photo.
    train = np.flatnonzero(run.read("role") == 1).tolist()
    shown = read_reconstruction(store, run).render(read_cameras(store.captured, train), 1).image
    photo = store.captured.read_image("image", train[1])
    assert torch.equal((shown * 255).round().to(torch.uint8), torch.from_numpy(photo))
    source = open_source(one.store_path, None, "scene")
    assert next(render_views(source, read_cameras(store.captured, train), 0.5)).image.shape == (12, 16, 3)
    assert pending(one) == []
    # The metric: one line in the one table.
    added = Metric("brightness_error", "brightness", "1", "lower", 3, "difference of mean brightness", brightness)
    monkeypatch.setattr(measures, "METRICS", (*measures.METRICS, added))
    assert [step.stage for step in pending(one)] == ["evaluate"], "rows that lack it are made again"
    earlier = read_rows(out / "metrics", metric_table())
    assert "brightness_error" not in earlier.column_names
    run_stages(one, *STAGES)
    rows = read_rows(out / "metrics", metric_table())
    assert rows.schema.field("brightness_error").metadata[b"meaning"] == b"difference of mean brightness"
    [summary] = summary_rows(out)
    assert summary["brightness_error"] == pytest.approx(np.mean(rows["brightness_error"].to_pylist()))
    assert compare(out, out) == 0
    page = write_report(out)
    assert "<th>brightness</th>" in page.read_text()
    assert f"{summary['brightness_error']:.3f}" in page.read_text()
    assert "brightness" in (out / "report.md").read_text()


def test_its_settings_are_refused_by_name_and_change_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from schemas.errors import ConfigError

    install_guide(tmp_path / "site", monkeypatch, "own_reconstructor.md", GROUP)
    with pytest.raises(ConfigError, match="reconstruct.overrides: there is nothing to set"):
        expected_steps(job(tmp_path, "reconstruct.overrides={iterations: 3}"))
    ours = expected_steps(job(tmp_path, "reconstruct.method=zipnerf"))["reconstruct"]
    theirs = expected_steps(job(tmp_path))["reconstruct"]
    assert ours.key != theirs.key
    assert "method" not in ours.config, "fields of before the seam stay what is wanted"
    assert theirs.config["method"] == "nearest_photo"


class Theirs(solvers.Solver):
    """Steps as DDIM does: only here to be found."""

    def step(self, i: int, x: torch.Tensor, clean: torch.Tensor) -> torch.Tensor:
        return self._first_order(i, x, clean)


def test_a_strangers_solver_is_known_to_the_configuration_and_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(solvers.SOLVERS, "theirs", Theirs)
    assert job(tmp_path, "sample.solver=theirs").config.sample.solver == "theirs"
    assert SamplerConfig("theirs").solver == "theirs"
    nodes = torch.tensor([-6.0, 0.0, 4.0, math.inf], dtype=torch.float64)
    start = torch.linspace(-1, 1, 5, dtype=torch.float64)
    ours, theirs = (solvers.integrate(start, nodes, lambda x, _: 0.5 * x, name) for name in ("ddim", "theirs"))
    assert torch.equal(ours, theirs)
