"""The report's table "Skipped, and what it saved" names every switch of the configuration that did something."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.runner import opened, run_missing
from flows.reporting.report import scene_section, skipped_work, write_report
from flows.stages import match as match_stage
from flows.stages import plan as plan_stage
from flows.stages import sample as sample_stage
from schemas.decisions import Decision
from schemas.skip import SkipConfig
from schemas.stages import StageRecord
from tests.flows.workers.scene import random_model

#: A training long enough for every switch of it to act, on views large enough for the perceptual network.
TRAINING = (
    "reconstruct.overrides={iterations: 40, warmup_iterations: 4, plateau_every: 2, plateau_patience: 1, "
    "plateau_tolerance: 0.99, plateau_from: 0.1, patch_size: 32, grid_log2_table: 10}"
)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Of four runs of one scene in which each switch acts at least once, as some exclude each other. The second path
    of the first is the first one again, which adds nothing to the coverage."""
    out = tmp_path_factory.mktemp("skipped")
    model = random_model(out / "tiny.safetensors")

    def run(label: str, until: str, switches: dict[str, bool], *settings: str) -> Job:
        skip = ", ".join(f"{name}: {str(on).lower()}" for name, on in switches.items())
        texts = [
            f"skip={{{skip}}}",
            f"label={label}",
            "method=cat3d",
            f"sample.checkpoint={model}",
            "sample.guidance=3",
            TRAINING,
        ]
        config = make_config({}, None, [*texts, "sample.guidance=3", *settings])
        [job] = Request("procedural:dtu/3?views=9&width=48&height=36", out, ("3",), config).jobs()
        with opened(job):
            run_missing(job, until=until)
        return job

    every, none = (dict.fromkeys(SkipConfig.model_fields, on) for on in (True, False))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sample_stage, "NEAR", 1e9)
        run(
            "most",
            "reconstruct",
            every | {"rounds": False, "covered_path": False},
            "plan.scales=[1, 1]",
            "plan.views=10",
        )
        patch.setattr("flows.generation.rounds.BRIEF_FLOPS", 0.0)
        run("rounds", "sample", none | {"rounds": True}, "plan.views=20", "sample.steps=2")
        patch.setattr(match_stage, "UNEXPLAINED_SHARE", 1.0)
        run("explained", "sample", none | {"explained": True}, "plan.views=5", "sample.steps=2", "hints.use=always")
        patch.setattr(plan_stage, "COVERED_SHARE", 0.0)
        job = run("covered", "plan", none | {"covered_path": True}, "plan.views=20")
    write_report(out)
    assert "Skipped, and what it saved" in (out / "report.html").read_text()
    return skipped_work([scene_section(out, job.store_path, [])])


@pytest.mark.slow
@pytest.mark.parametrize("switch", list(SkipConfig.model_fields))
def test_every_switch_is_found_in_the_table_with_what_it_saved(table: list[dict[str, Any]], switch: str) -> None:
    rows = [row for row in table if row["switch"] == switch]
    assert rows
    for row in rows:
        assert row["runs"] >= 1
        if switch not in ("empty_space", "workers"):  # queries of the field, and time to start, are not counted
            assert row["saved"], row["sentence"]
        assert all(count > 0 for count in row["saved"].values())


def test_rows_are_counted_by_stage_and_switch_and_not_by_sentence() -> None:
    def decisions(*texts: str) -> dict[str, list[Decision]]:
        return {"sample": [Decision(kind="skipped", switch="rounds", text=t, saved={"groups": 2}) for t in texts]}

    runs = [{"name": "a", "decisions": decisions("2 of 4 groups", "another way to say it")},
            {"name": "b", "decisions": {"plan": [Decision(kind="chosen", text="Skipped nothing")]}}]  # fmt: skip
    [row] = skipped_work([{"id": "scene", "runs": runs}])
    assert (row["stage"], row["switch"], row["runs"], row["alike"]) == ("sample", "rounds", 1, True)
    assert dict(row["saved"]) == {"groups": 4}


def test_records_of_earlier_versions_hold_sentences() -> None:
    record = StageRecord.model_validate(
        {"stage": "plan", "key": "1" * 64, "started_at": "", "finished_at": "", "seconds": 1, "decisions": ["Skipped."]}
    )
    assert record.decisions == [Decision(kind="chosen", text="Skipped.")]
    assert StageRecord.model_validate_json(record.model_dump_json()) == record


def test_the_report_of_an_older_folder_is_written(tmp_path: Path) -> None:
    assert write_report(tmp_path).exists()
