"""Many scenes sampled together by one set of workers, before their own flows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flows.sampling.ahead import sample_ahead
from tests.flows.sampling.scene import make_job, run_of, run_stages


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
