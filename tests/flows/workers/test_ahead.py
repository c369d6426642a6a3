"""Many scenes sampled together by one set of workers, before their own flows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from cat3d_core.diffusion import SIZES, MultiViewModel, save_model
from flows.pipeline.ahead import sample_ahead
from flows.pipeline.keys import pending
from tests.flows.workers.scene import make_job, run_of, run_stages


def test_runs_are_prepared_and_sampled_together_and_their_own_flows_find_it_done(
    checkpoint: Path, expected: dict[str, np.ndarray], tmp_path: Path, capsys
) -> None:
    jobs = [make_job(tmp_path, checkpoint, split, workers=2) for split in ("3", "1")]
    broken = make_job(tmp_path / "other", checkpoint, "3").model_copy(update={"source": "/nowhere"})
    totals = sample_ahead([*jobs, broken])
    assert totals.workers == 2
    assert totals.batches >= 7
    assert "together with others failed: " in capsys.readouterr().out
    for job, split in zip(jobs, ("3", "1")):
        assert np.array_equal(run_of(job).generated.read("latent"), expected[split])
        record = run_stages(job, "sample")["sample"]
        assert record.work["groups"] == 0
    assert sample_ahead(jobs).batches == 0


def test_a_run_with_another_encoder_does_not_sample_from_this_ones_latents(
    checkpoint: Path, expected: dict[str, np.ndarray], tmp_path: Path
) -> None:
    """A scene keeps one encoding: that of the second run replaced that of the first before it was sampled."""
    other = tmp_path / "larger.safetensors"
    larger = replace(SIZES["tiny"], unet=replace(SIZES["tiny"].unet, latent_size=4))
    save_model(other, MultiViewModel(larger), {})
    first, second = make_job(tmp_path, checkpoint, "3"), make_job(tmp_path, other, "1")
    sample_ahead([first, second])
    assert np.array_equal(run_of(first).generated.read("latent"), expected["3"])
    assert run_stages(first, "sample")["sample"].work["groups"] == 0
    assert run_stages(second, "plan", "encode", "sample")["sample"].work["groups"] > 0
    assert run_of(second).generated.read("latent").shape[-1] == 4
    for job in (first, second):
        assert "encode" not in {step.stage for step in pending(job)}
