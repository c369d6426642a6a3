"""Two things go wrong, one after the other: the second while the first is being mended."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from flows.errors import describe
from flows.pipeline.keys import downstream
from schemas import documents
from schemas.documents import nodes, read_metadata, write_group, write_metadata
from schemas.errors import StoreError
from schemas.layout import SCHEMA_VERSION
from schemas.scene_store import SceneStore
from schemas.verify import verify
from tests.reliability.test_state_machine import (
    Killed,
    contents,
    job_of,
    killed_after,
    run_until,
    undisturbed,  # noqa: F401
)

RUN = "v3-zipnerf"


@pytest.mark.parametrize("writes", [3, 11, 30])
def test_killed_again_and_again_while_it_goes_on(undisturbed, tmp_path: Path, writes: int) -> None:  # noqa: F811
    """Every run gets only so many writes further than the one before, until there is nothing to do."""
    job, kills = job_of(tmp_path, RUN), 0
    for attempt in range(1, 200):
        try:
            with killed_after(writes * attempt):
                run_until(job, "evaluate")
            break
        except Killed:
            kills += 1
    assert kills >= 2
    assert contents(SceneStore.open(job.store_path), RUN) == undisturbed[RUN]
    assert list(verify(SceneStore.open(job.store_path))) == []


def test_damage_found_while_it_goes_on_names_the_stage_to_redo(undisturbed, tmp_path: Path) -> None:  # noqa: F811
    job = job_of(tmp_path, RUN)
    run_until(job, "poses")
    chunk = next((job.store_path / "captured" / "image").glob("c.1.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(StoreError, match="View 1 of .*captured/image is damaged on disk .*: run the stage"):
        run_until(job, "evaluate")
    store = SceneStore.open(job.store_path, "r+")
    store.invalidate(downstream("ingest"), RUN)
    with pytest.raises(Killed), killed_after(4):  # and killed while it is mended
        run_until(job, "evaluate")
    run_until(job, "evaluate")
    assert contents(SceneStore.open(job.store_path), RUN) == undisturbed[RUN]


def _of_version_1(store: Path) -> None:
    for path, kind in nodes(store):
        if kind == "array":
            document = read_metadata(store / path)
            write_metadata(store / path, document | {"dimension_names": None, "attributes": {}})
    write_group(store, SceneStore.open(store).attrs | {"schema_version": 1})


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO])
def test_a_full_disk_during_a_migration(undisturbed, tmp_path: Path, error: int) -> None:  # noqa: F811
    """At every write of it in turn."""
    job = job_of(tmp_path, RUN)
    run_until(job, "evaluate")
    _of_version_1(job.store_path)
    replace, failures = documents.os.replace, 0

    def limited(count: int) -> Callable[..., Any]:
        left = [count]

        def call(*arguments: Any) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(error, "refused", str(arguments[0]))
            replace(*arguments)

        return call

    for count in range(0, 400, 3):  # each goes on from what the one before has left
        try:
            with mock.patch.object(documents.os, "replace", limited(count % 7)):
                SceneStore.open(job.store_path, "r+")
            break
        except OSError as failed:
            failures, said = failures + 1, describe(failed) or ""
            assert said.startswith("The system refused")
            assert contents(SceneStore.open(job.store_path), RUN) == undisturbed[RUN], "readable as it is"
    assert failures > 3
    assert SceneStore.open(job.store_path).attrs["schema_version"] == SCHEMA_VERSION
    assert contents(SceneStore.open(job.store_path), RUN) == undisturbed[RUN]
    assert list(verify(SceneStore.open(job.store_path))) == []
