"""A Dask cluster that is running already: the same store, also when its workers are killed or hang."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import distributed
import numpy as np
import pytest

from flows.workers import dask_executor
from tests.flows.workers.scene import chunk_times, run_of, run_stages


@pytest.fixture(scope="module")
def cluster(prefect_url: str) -> Iterator[distributed.LocalCluster]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0", resources={"GPU": 1},
        silence_logs=50,
    ) as cluster:  # fmt: skip
        yield cluster


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_a_lost_dask_workers_groups_are_taken_over(scene, expected, cluster, kind: signal.Signals) -> None:
    job = scene(
        executor="dask",
        dask_address=cluster.scheduler_address,
        dask_resources="{GPU: 1}",
        batch_seconds=100,
        timeout_s=30,
    )
    struck: list[int] = []

    def strike() -> None:
        with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:  # before: it takes a while
            while not chunk_times(job):
                time.sleep(0.02)
            deadline = time.monotonic() + 60
            while not (busy := [a for a, batches in client.processing().items() if batches]):
                assert time.monotonic() < deadline, "the work ended before a worker was struck"
                time.sleep(0.01)
            struck.append(client.run(os.getpid, workers=busy[:1])[busy[0]])
            os.kill(struck[0], kind)

    trouble = threading.Thread(target=strike)
    trouble.start()
    record = run_stages(job, "sample")["sample"]
    trouble.join()
    assert struck
    assert record.work["workers"] == 2
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])
    if kind == signal.SIGSTOP:
        assert any("finished nothing for" in d.text for d in record.decisions)


def test_an_answer_that_never_comes_is_a_lost_worker(cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_executor, "ANSWER_TIMEOUT_S", 0.5)
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        future = client.submit(os.getpid, pure=False)
        while future.status == "pending":
            time.sleep(0.01)
        pid = client.run(os.getpid, workers=list(client.who_has([future])[future.key]))
        worker = next(iter(pid.values()))
        os.kill(worker, signal.SIGSTOP)
        try:
            answer = dask_executor._answer(3, future)
        finally:
            os.kill(worker, signal.SIGCONT)
    assert (answer.number, answer.error) == (3, "")
    assert "stopped before it could say so" in answer.died
