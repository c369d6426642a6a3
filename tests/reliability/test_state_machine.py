"""A scene store and its runs under anything that may happen to them, in any order, against a plain model of what each
run must hold: made, extended, migrated, damaged, killed, verified, reprocessed, exported."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from flows.commands.export import SurfaceSettings, export_command
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.pipeline.keys import downstream, pending
from flows.pipeline.runner import execute_stage, opened, prepare_run
from schemas import arrays, documents
from schemas.documents import nodes, read_metadata, write_group, write_metadata
from schemas.layout import SCENE_STAGES, SCHEMA_VERSION, array_spec
from schemas.scene_store import SceneStore
from schemas.section import Section
from schemas.verify import run_of, verify
from tests.reliability.tiny import SETTINGS, SOURCE

#: Two splits, and two seeds of the first.
RUNS = {"v3-zipnerf": ("3", 0), "v3-zipnerf-s1": ("3", 1), "v1-zipnerf": ("1", 0)}
STAGES = ("ingest", "poses", "reconstruct", "render", "evaluate")
runs, stages = st.sampled_from(sorted(RUNS)), st.sampled_from(STAGES)


def job_of(out: Path, run: str) -> Job:
    split, seed = RUNS[run]
    config = make_config({}, None, [*SETTINGS[1:], "method=zipnerf", f"seed={seed}"])
    job = Request(SOURCE, out, (split,), config).jobs()[0]
    assert job.run == run
    return job


def run_until(job: Job, stage: str) -> None:
    with opened(job):
        prepare_run(job)
        for step in pending(job):
            if STAGES.index(step.stage) <= STAGES.index(stage):
                execute_stage(job, step)


def contents(store: SceneStore, run: str) -> str:
    """Digest of the arrays that a run can see: its own, and those of the scene."""
    found = hashlib.sha256()
    for path, kind in nodes(store.folder):
        if kind != "array" or run_of(path) not in (None, run) or path.endswith("field/record"):
            continue
        parent, _, name = path.rpartition("/")
        values = Section(store.root, parent, False).read(name)
        found.update(
            path.encode() + (repr(values.tolist()).encode() if values.dtype.kind in "OT" else values.tobytes())
        )
    return found.hexdigest()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Run -> digest of what it holds where nothing happens."""
    digests = {}
    for run in RUNS:
        job = job_of(tmp_path_factory.mktemp("undisturbed"), run)
        run_until(job, "evaluate")
        digests[run] = contents(SceneStore.open(job.store_path), run)
    return digests


class Killed(BaseException):
    """Ends the work as a signal does: nothing is cleaned up by those who clean up after errors."""


@contextmanager
def killed_after(writes: int) -> Iterator[None]:
    """Ends the work before its next write, once so many were done; and leaves a file as a killed writer does."""
    left = [writes]
    replace, write = documents.os.replace, arrays.write

    def count(call, target, *arguments):  # type: ignore[no-untyped-def]
        if not left[0]:
            raise Killed
        left[0] -= 1
        return call(target, *arguments)

    with (
        mock.patch.object(documents.os, "replace", lambda *a: count(replace, *a)),
        mock.patch.object(arrays, "write", lambda *a: count(write, *a)),
    ):
        yield


class Machine(RuleBasedStateMachine):
    """`damaged`: arrays of which a file was changed; what the others hold must be right at any time."""

    expected: dict[str, str] = {}

    def __init__(self) -> None:
        super().__init__()
        self.out = Path(tempfile.mkdtemp(prefix="cat3d-machine-"))
        self.done: dict[str, set[str]] = {run: set() for run in RUNS}
        self.damaged: set[str] = set()

    def teardown(self) -> None:
        shutil.rmtree(self.out)

    @property
    def store_path(self) -> Path:
        return self.out / "procedural_dtu_3.zarr"

    @rule(run=runs, stage=stages)
    def make_or_extend(self, run: str, stage: str) -> None:
        self._mend()
        run_until(job_of(self.out, run), stage)
        self._record()

    @rule(run=runs, writes=st.integers(0, 60))
    def kill(self, run: str, writes: int) -> None:
        self._mend()
        try:
            with killed_after(writes):
                run_until(job_of(self.out, run), "evaluate")
        except Killed:
            pass
        self._record()

    @precondition(lambda self: self.store_path.exists())
    @rule(choice=st.integers(0, 10_000), how=st.sampled_from(["flip", "cut", "remove"]))
    def damage(self, choice: int, how: str) -> None:
        files = [path for path in sorted(self.store_path.rglob("c*")) if path.is_file() and path.suffix != ".partial"]
        files = [path for path in files if array_spec(str(path.parent.relative_to(self.store_path))) is not None]
        if not files:
            return
        file = files[choice % len(files)]
        data = bytearray(file.read_bytes())
        if how == "flip":
            data[choice % len(data)] ^= 1 << choice % 8
        file.write_bytes(data if how == "flip" else data[: len(data) // 2])
        if how == "remove":
            file.unlink()
        path = str(file.parent.relative_to(self.store_path))
        self.damaged.add(path)
        said = {p.path for p in verify(SceneStore.open(self.store_path))}
        if how != "remove":
            assert path in said, f"{how} of {file} is not seen"

    @precondition(lambda self: self.store_path.exists())
    @rule(run=runs, stage=stages)
    def reprocess(self, run: str, stage: str) -> None:
        self._mend()
        store = SceneStore.open(self.store_path, "r+")
        if stage in SCENE_STAGES or run in store.runs():
            store.invalidate(downstream(stage), run)
        self._record()

    @precondition(lambda self: self.store_path.exists() and not self.damaged)
    @rule()
    def migrate(self) -> None:
        """The store is what version 1 wrote, which had neither names of dimensions nor units, and is opened."""
        for path, kind in nodes(self.store_path):
            if kind == "array":
                document = read_metadata(self.store_path / path)
                write_metadata(self.store_path / path, document | {"dimension_names": None, "attributes": {}})
        write_group(self.store_path, SceneStore.open(self.store_path).attrs | {"schema_version": 1})
        before = self._digests()
        store = SceneStore.open(self.store_path, "r+")
        assert store.attrs["schema_version"] == SCHEMA_VERSION
        assert self._digests() == before

    @precondition(lambda self: not self.damaged and any("reconstruct" in done for done in self.done.values()))
    @rule()
    def export(self) -> None:
        run = next(run for run, done in self.done.items() if "reconstruct" in done)
        before = self._digests()
        made = export_command(self.store_path, run, "points", self.out / "exports", "world", SurfaceSettings(views=1))
        assert made
        assert made[0].stat().st_size > 100
        assert self._digests() == before

    @invariant()
    def finished_runs_hold_what_they_must(self) -> None:
        if self.damaged or not self.store_path.exists():
            return
        for run, done in self.done.items():
            if set(STAGES) <= done:
                assert contents(SceneStore.open(self.store_path), run) == self.expected[run], run

    @invariant()
    def nothing_is_wrong_but_what_was_damaged(self) -> None:
        if not self.store_path.exists():
            return
        found = [p for p in verify(SceneStore.open(self.store_path)) if p.kind != "orphan"]
        assert {p.path for p in found} <= self.damaged, [p.message for p in found]

    def _mend(self) -> None:
        """As a user does whom `cat3d inspect --verify` has told which arrays are damaged: redo what writes them."""
        if not self.damaged:
            return
        store = SceneStore.open(self.store_path, "r+")
        for path in self.damaged:
            stage = array_spec(path).stage  # type: ignore[union-attr]
            if stage is not None:
                store.invalidate(downstream(stage), run_of(path))
        for run in store.runs():
            run_until(job_of(self.out, run), "evaluate")
        self.damaged.clear()
        self._record()

    def _record(self) -> None:
        """The model follows the store's records: of these it is asked whether they tell the truth."""
        if not self.store_path.exists():
            return
        store = SceneStore.open(self.store_path)
        for run in RUNS:
            known = run in store.runs()
            job = job_of(self.out, run)
            stale = {step.stage for step in pending(job)} if known else set(STAGES)
            self.done[run] = set(STAGES) - stale

    def _digests(self) -> dict[str, str]:
        store = SceneStore.open(self.store_path)
        out = {}
        for path, kind in nodes(store.folder):
            if kind == "array":
                chunks = sorted((f.name, f.read_bytes()) for f in (store.folder / path).glob("c*"))
                out[path] = hashlib.sha256(repr(chunks).encode()).hexdigest()
        return out


@pytest.mark.parametrize(
    ("examples", "steps"),
    [(2, 10), pytest.param(20, 30, marks=[pytest.mark.slow, pytest.mark.timeout(1400)])],
    ids=["short", "long"],
)
def test_a_store_under_anything_in_any_order(undisturbed: dict[str, str], examples: int, steps: int) -> None:
    Machine.expected = undisturbed
    health = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=examples, stateful_step_count=steps, deadline=None, derandomize=True,
            suppress_health_check=health,
        ),
    )  # fmt: skip
