"""Where batches run, as the settings say: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from pathlib import Path

from flows.workers.protocol import Executor
from schemas.execution import ExecutionConfig


def open_executor(settings: ExecutionConfig, log_folder: Path) -> Executor:
    """The executor the settings ask for. log_folder: for the logs of workers."""
    if settings.executor == "dask":
        from flows.workers.dask_executor import DaskExecutor  # takes a second to import

        return DaskExecutor(settings)
    from flows.workers.local import LocalExecutor

    return LocalExecutor(settings, log_folder)
