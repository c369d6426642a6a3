"""Where and how work is done."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, PositiveFloat, PositiveInt

from schemas.strict import StrictModel


class ExecutionConfig(StrictModel):
    """Where and how the work is done. Nothing here changes a result beyond rounding."""

    executor: Literal["local", "dask"] = "local"
    """`local`: processes on this machine; `dask`: a Dask cluster, through prefect-dask."""
    workers: PositiveInt | None = None
    """Processes; None: one per GPU, or without GPUs one per `threads` CPU cores."""
    threads: PositiveInt = 1
    """CPU threads of each worker: with equal numbers results are equal bit for bit."""
    groups_at_once: PositiveInt = 1
    """Groups in one evaluation of the network. With 1 results are bit-identical however the work is shared out."""
    batch_seconds: PositiveFloat = 10.0
    """Groups are handed out in batches that take about this long, by what was measured so far."""
    timeout_s: PositiveFloat = 600.0
    """A worker that finishes nothing and gives no sign of life for so long is given up, its work handed to another."""
    attempts: PositiveInt = 3
    """Workers that may die on one and the same group or stage before the stage fails."""
    checkpoint_s: PositiveFloat = 20.0
    """Between two saved states of a reconstruction under way, in seconds: what a lost worker costs at most."""
    dask_address: str | None = None
    """Scheduler of a running Dask cluster, e.g. tcp://10.0.0.1:8786."""
    dask_cluster: str | None = None
    """Class of the cluster to start, e.g. dask_jobqueue.SLURMCluster; None: a LocalCluster on loopback."""
    dask_options: dict[str, Any] = Field(default_factory=dict)
    """Keyword arguments of that class."""
    dask_resources: dict[str, Annotated[FiniteFloat, Field(ge=0)]] = Field(default_factory=dict)
    """Dask resources that work occupies, e.g. {GPU: 1}; workers must be started with them. GPU is not asked for by what
    computes on none."""
