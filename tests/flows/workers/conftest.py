"""A prepared scene, copied for each test, and its uninterrupted result to compare with."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from flows.jobs.job import Job
from tests.flows.workers.scene import make_job, prepare, random_model, run_of, run_stages

if TYPE_CHECKING:
    from tests.flows.workers.dask_faults import Calls


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory, checkpoint: Path) -> Path:
    """A folder with the store of a scene whose runs with 3 and with 1 views are ready to be sampled."""
    out = tmp_path_factory.mktemp("prepared")
    for split in ("3", "1"):
        prepare(make_job(out, checkpoint, split))
    return out


@pytest.fixture
def scene(prepared: Path, checkpoint: Path, tmp_path: Path) -> Callable[..., Job]:
    """Make a job on a copy of the prepared store; same arguments as `make_job`."""

    def make(split: str = "3", **execution: Any) -> Job:
        out = tmp_path / "out"
        if not out.exists():
            shutil.copytree(prepared, out)
        return make_job(out, checkpoint, split, **({"workers": 1} | execution))

    return make


@pytest.fixture(scope="session")
def expected(prepared: Path, checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Latents of the uninterrupted runs with one worker, by split."""
    out = tmp_path_factory.mktemp("expected") / "out"
    shutil.copytree(prepared, out)
    result = {}
    for split in ("3", "1"):
        job = make_job(out, checkpoint, split, workers=1)
        run_stages(job, "sample")
        result[split] = run_of(job).generated.read("latent")
    return result


@pytest.fixture(scope="module")
def address(prefect_url: str) -> Iterator[str]:
    """The scheduler of two Dask workers in this process."""
    import distributed

    from tests.flows.workers.dask_faults import HERE

    with distributed.LocalCluster(n_workers=2, **HERE) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def calls() -> Iterator[Calls]:
    """Calls of ours to Dask, counted."""
    from tests.flows.workers.dask_faults import Calls

    with Calls().watched() as found:
        yield found
