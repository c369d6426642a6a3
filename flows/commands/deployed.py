"""The commands as flows that a team deploys (infra/prefect.yaml): `run`, `sweep`, `reprocess`, with typed parameters.

They do what the commands of the same names do. Their results are folders, and artifacts in Prefect's interface.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from prefect import flow
from pydantic import Field

from flows.commands.reprocess import reprocess_command
from flows.commands.run import run_command
from flows.commands.sweep import named_sweep, with_settings
from flows.errors import WorkerError
from flows.jobs.request import Request
from flows.object_storage import results_at
from flows.pipeline.sweep import run_sweep
from schemas.config import RunConfig
from schemas.execution import ExecutionConfig

StageName = Literal[
    "ingest", "poses", "plan", "match", "encode", "sample", "decode", "reconstruct", "render", "evaluate"
]
Out = Annotated[Path, Field(title="Results", description="A folder that all workers share, or s3://BUCKET/FOLDER.")]
Execution = Annotated[
    ExecutionConfig | None,
    Field(title="Where the work is done", description="Processes of the worker's machine, or a Dask cluster."),
]
Further = Annotated[
    dict[str, Any] | None,
    Field(title="Further settings", description='Of all runs, for example {"reconstruct": {"preset": "balanced"}}.'),
]


@flow(name="run", flow_run_name="run {source}")
def run(
    source: Annotated[str, Field(title="Scene", description="Its folder, or procedural:FAMILY/SEED.")],
    out: Out,
    views: Annotated[list[str], Field(title="Training views", description="Splits: counts, or all.")] = ["all"],  # noqa: B006
    config: Annotated[RunConfig | None, Field(title="Settings", description="Of the run; none: defaults.")] = None,
) -> None:
    """Photos of one scene in, a 3D scene out: renders, metrics and a report. What is done already is not done again."""
    with results_at(out) as folder:
        run_command(Request(source, folder.resolve(), tuple(views), config or RunConfig()))


@flow(name="sweep", flow_run_name="sweep {sweep}")
def sweep(
    sweep: Annotated[str, Field(title="Sweep", description="A sweep's YAML file, or the name of a shipped one.")],
    out: Out,
    execution: Execution = None,
    settings: Further = None,
) -> None:
    """Benchmark sweep: scenes x training views x methods x seeds. Run again, it fills in what is missing."""
    with results_at(out) as folder:
        problems = run_sweep(with_settings(named_sweep(sweep), _settings(execution, settings)), folder)
    _fail_with(problems)


@flow(name="reprocess", flow_run_name="reprocess {out}")
def reprocess(
    out: Out,
    split: Annotated[str | None, Field(title="Training views", description="Only runs with this split.")] = None,
    from_stage: Annotated[
        StageName | None, Field(title="From stage", description="Redo this stage and all after it.")
    ] = None,
    where: Annotated[
        list[str] | None, Field(title="Only runs that match", description="For example scene=llff_* or method=cat3d.")
    ] = None,
    execution: Execution = None,
    settings: Further = None,
    dry_run: Annotated[bool, Field(title="Only say what is stale, why, and what it costs")] = False,
) -> None:
    """Redo what is stale after a change of photos, cameras, splits, settings, code or model, and nothing else."""
    with results_at(out, writes=not dry_run) as folder:
        problems = reprocess_command(folder, split, from_stage, where or [], _settings(execution, settings), dry_run)
    _fail_with(problems)


def _settings(execution: ExecutionConfig | None, settings: dict[str, Any] | None) -> dict[str, Any]:
    given = {} if execution is None else {"execution": execution.model_dump(mode="json", exclude_unset=True)}
    return given | (settings or {})


def _fail_with(problems: list[str]) -> None:
    """A flow with failures is a failed one, as the command's exit code says; what is done is kept."""
    if problems:
        raise WorkerError(f"{len(problems)} failed: " + " ".join(problems))
