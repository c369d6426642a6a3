"""Units of work that can be done anywhere: a batch of a stage's items, and what came of it. JSON in, JSON out."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence

from pydantic import BaseModel, ConfigDict, Field, ImportString

from cat3d_core.reconstruction import NonFiniteError
from flows.errors import InputError, WorkerError
from flows.jobs.device import cpu_threads
from flows.jobs.job import Job
from flows.jobs.usage import Usage, measured
from schemas.errors import ConfigError, StoreError
from schemas.scene_store import SceneStore, Section

#: Errors that a user can act on keep their type on the way from a worker.
KNOWN_ERRORS = {e.__name__: e for e in (InputError, ConfigError, StoreError, WorkerError, NonFiniteError)}


#: What a worker loads before its first item, and keeps.
Load = Callable[[Job], object]
#: Does the items that aren't done yet, one after another.
Share = Callable[[Job, SceneStore, str, Sequence[int]], None]


class Batch(BaseModel):
    """Items of one stage of one job, for one worker; load and share are sent as the names of the functions."""

    model_config = ConfigDict(frozen=True)

    number: int
    job: Job
    stage: str
    key: str
    items: tuple[int, ...]
    load: ImportString[Load]
    share: ImportString[Share]


class Answer(BaseModel):
    """What a worker did with a batch. `died`: the worker, not the work, failed. Seconds and usage are the worker's."""

    number: int
    seconds: float = 0.0
    loading_seconds: float = 0.0
    usage: Usage = Field(default_factory=Usage)
    died: str = ""
    error: str = ""
    message: str = ""

    def raise_error(self) -> None:
        """Raise the error the worker met, as its own type where a user can act on it."""
        if self.error:
            raise KNOWN_ERRORS.get(self.error, RuntimeError)(self.message)


def run_batch(batch: Batch) -> Answer:
    """Do a batch in this process, with the job's number of threads."""
    started = loaded = time.monotonic()
    try:
        with measured() as usage, cpu_threads(batch.job.config.execution.threads):
            batch.load(batch.job)
            loaded = time.monotonic()
            store = SceneStore.open(batch.job.store_path, "r+")
            batch.share(batch.job, store, batch.key, batch.items)
    except Exception as error:
        kind = next((name for name, known in KNOWN_ERRORS.items() if isinstance(error, known)), type(error).__name__)
        message = str(error) if kind in KNOWN_ERRORS else traceback.format_exc()
        return Answer(number=batch.number, error=kind, message=message)
    ended = time.monotonic()
    return Answer(number=batch.number, seconds=ended - loaded, loading_seconds=loaded - started, usage=usage)


def is_done(section: Section, marker: str, view: int, key: str, data: str | None = None) -> bool:
    """Whether a view is marked with exactly this content key, and (slower) whether its chunk of `data` is whole."""
    try:
        done = bool(section.read(marker, [view])[0].tobytes().hex() == key)
        if done and data:
            section.read(data, [view])
        return done
    except StoreError:
        return False


class Work:
    """One stage of one job to be shared out: items (groups, views) in passes, one pass after another.

    load, share: functions of a module (not of another function), as a worker finds them by name.
    views: the views each item makes; their content keys in `marker` say what is done, and `data` is read to make sure.
    """

    def __init__(
        self, job: Job, stage: str, key: str, load: Load, share: Share, section: Section, marker: str, data: str,
        keys: Sequence[str], passes: Sequence[Sequence[int]], views: Sequence[Sequence[int]],
    ) -> None:  # fmt: skip
        self.job, self.stage, self.key, self.load, self.share = job, stage, key, load, share
        self.section, self.marker, self.data, self.keys = section, marker, data, list(keys)
        self.views = views
        self.passes = [self.missing(items) for items in passes]

    def batch(self, number: int, items: Sequence[int]) -> Batch:
        """Some of the items, to be sent to a worker."""
        return Batch(
            number=number, job=self.job, stage=self.stage, key=self.key, items=tuple(items), load=self.load,
            share=self.share,
        )  # fmt: skip

    def missing(self, items: Sequence[int]) -> list[int]:
        """Those of the items that have a view which isn't there whole and marked as done. Reads the data."""
        done = self.section.done(self.marker, self.keys, [self.data])
        return [i for i in items if not all(done[v] for v in self.views[i])]

    def finished(self, item: int) -> bool:
        """Whether the item is marked as done; cheap, for watching."""
        return all(is_done(self.section, self.marker, v, self.keys[v]) for v in reversed(self.views[item]))
