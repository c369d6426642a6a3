"""Every call to Dask fails once in turn in work that takes no time: it goes on, or ends in a sentence."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from flows.errors import WorkerError
from flows.jobs.job import Job
from flows.jobs.needs import Needs
from flows.workers import dask_executor
from flows.workers.fan_out import fan_out
from flows.workers.work import Work
from schemas.config import RunConfig
from schemas.execution import ExecutionConfig
from schemas.scene_store import SceneStore
from tests.flows.workers.dask_faults import HERE, LIMIT_S, POINTS, Calls, limited

OWN = {"dask_cluster": "distributed.LocalCluster", "dask_options": HERE | {"n_workers": 1}, "workers": 1}


def write_items(job: Job, _store: SceneStore, _key: str, items: Sequence[int], hangs: bool = False) -> None:
    for item in items:
        if hangs and item == 1:
            try:
                (job.out / "hung").touch(exist_ok=False)  # the first worker at it waits until it is let go
            except FileExistsError:
                pass
            else:
                while not (job.out / "let go").exists():
                    time.sleep(0.05)
        (job.out / f"{item}.txt").write_text(str(item))


def load_nothing(_job: Job) -> None:
    pass


class Items(Work):
    def size(self, items: Iterable[int]) -> int:
        return len(list(items))

    def finished(self, item: int) -> bool:
        return (self.job.out / f"{item}.txt").exists()


def items_of(out: Path, address: str | None = None, hangs: bool = False, **execution: Any) -> Items:
    settings = {"executor": "dask", "dask_address": address, "batch_seconds": 0.001, **execution}
    config = RunConfig(execution=ExecutionConfig(**settings))
    job = Job(source="procedural:none/1", out=out, scene_id="s", dataset="none", config=config)
    if not job.store_path.exists():
        out.mkdir(exist_ok=True)
        SceneStore.create(job.store_path, "s", "none", {})
    left = [i for i in range(3) if not (out / f"{i}.txt").exists()]
    return Items(job, "items", "0" * 64, Needs(), load_nothing, write_items, [left], {"hangs": hangs})


def do_items(out: Path, address: str | None = None, **options: Any) -> str:
    """The sentence that it ended with, or nothing."""
    work = items_of(out, address, **options)
    try:
        with limited(LIMIT_S):
            fan_out([work], work.job.config.execution, "items")
    except WorkerError as error:
        return str(error)
    return ""


def written(out: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(out.glob("?.txt"))}


ALL = {f"{i}.txt": str(i) for i in range(3)}
QUICK = ("Client", "scheduler_info", "submit", "add_done_callback", "get_worker", "result", "Client.close")


@pytest.mark.parametrize("name", QUICK)
def test_an_executors_call_fails_in_a_sentence_or_not_at_all(
    name: str, address: str, calls: Calls, tmp_path: Path
) -> None:
    calls.fail((name, 1))
    said = do_items(tmp_path / "out", address)
    assert len(calls.failed) == 1
    if name in ("result", "Client.close"):
        assert said == "", "the work was done"
    else:
        assert said.startswith(("The scheduler of the Dask cluster tcp://", "A worker of the Dask cluster cannot work"))
        assert str(calls.failed[0]) in said
    calls.fail()
    assert do_items(tmp_path / "out", address) == ""
    assert written(tmp_path / "out") == ALL


def test_a_connection_that_breaks_is_made_again(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    submit, sent = dask_executor.PrefectDaskClient.submit, []

    def broken(self: Any, *arguments: Any, **options: Any) -> Any:
        sent.append(submit(self, *arguments, **options))
        if len(sent) == 2:
            self.loop.add_callback(self.scheduler_comm.comm.abort)
        return sent[-1]

    monkeypatch.setattr(dask_executor.PrefectDaskClient, "submit", broken)
    assert do_items(tmp_path / "out", address) == ""
    assert written(tmp_path / "out") == ALL


def test_an_error_of_a_worker_that_cannot_be_fetched_is_a_lost_worker(
    address: str, calls: Calls, tmp_path: Path
) -> None:
    calls.fail(("get_worker", 1), ("exception", 1))
    assert do_items(tmp_path / "out", address) == ""
    assert len(calls.failed) == 2
    assert written(tmp_path / "out") == ALL


def test_a_word_that_is_no_address_and_a_client_that_is_closed_are_sentences(address: str, tmp_path: Path) -> None:
    with pytest.raises(dask_executor.ConfigError, match=r"execution.dask_address: garbage is no address .*port"):
        dask_executor.DaskExecutor(ExecutionConfig(executor="dask", dask_address="garbage"))
    executor = dask_executor.DaskExecutor(ExecutionConfig(executor="dask", dask_address=address))
    executor.close()  # as it closes itself when the scheduler does not come back
    executor.looked = -dask_executor.LOOK_S
    with pytest.raises(WorkerError, match="cannot be reached .the connection was lost"):
        executor.workers(Needs())
    with pytest.raises(WorkerError, match="cannot be reached"):
        executor.submit(items_of(tmp_path / "out", address).batch(1, (0,)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["processing", "cancel", "restart_workers", None])
def test_a_hanging_worker_without_a_keeper_gets_no_more_work(
    name: str | None, address: str, calls: Calls, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    calls.fail((name or "", 1))
    try:
        said = do_items(out, address, hangs=True, timeout_s=3)
        assert len(calls.failed) == bool(name)
        if name in ("processing", "cancel"):
            assert "cannot be reached" in said
        else:
            assert said == "", "the other worker did it"
    finally:
        (out / "let go").touch()
    calls.fail()
    assert do_items(out, address) == ""
    assert written(out) == ALL


@pytest.mark.slow
@pytest.mark.parametrize("name", ["LocalCluster", "adapt", "Client", "LocalCluster.close"])
def test_a_cluster_of_the_command_that_does_not_start_or_end_is_a_sentence_or_nothing(
    name: str, prefect_url: str, calls: Calls, tmp_path: Path
) -> None:
    for error in range(len(POINTS[name][2])):
        out = tmp_path / str(error)
        calls.fail((name, 1), error=error)
        said = do_items(out, **OWN)
        assert len(calls.failed) == 1
        assert (said == "") == (name == "LocalCluster.close"), said
        calls.fail()
        assert do_items(out, **OWN) == ""
        assert written(out) == ALL
