"""Units of work that can be done anywhere: a batch of a stage's items, and what came of it. JSON in, JSON out."""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ImportString

from cat3d_core.reconstruction import NonFiniteError
from flows.errors import InputError, WorkerError
from flows.jobs.device import cpu_threads
from flows.jobs.job import Job
from flows.jobs.needs import Needs
from flows.jobs.usage import Usage, measured
from schemas.errors import ConfigError, StoreError
from schemas.scene_store import SceneStore, Section

#: Errors that a user can act on keep their type on the way from a worker.
KNOWN_ERRORS = {e.__name__: e for e in (InputError, ConfigError, StoreError, WorkerError, NonFiniteError)}


#: What a worker loads before its first item, and keeps.
Load = Callable[[Job], object]
#: share(job, store, key, items, **arguments) does the items that aren't done yet, one after another.
Share = Callable[..., None]


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
    needs: Needs = Needs()
    arguments: dict[str, Any] = Field(default_factory=dict)


class Answer(BaseModel):
    """What a worker did with a batch. `died`: the worker, not the work, failed. Seconds and usage are the worker's."""

    number: int
    seconds: float = 0.0
    loading_seconds: float = 0.0
    usage: Usage = Field(default_factory=Usage)
    died: str = ""
    error: str = ""
    message: str = ""
    errno: int | None = None

    def raise_error(self) -> None:
        """Raise the error the worker met, as its own type where a user can act on it."""
        if self.errno is not None:
            raise OSError(self.errno, self.message)
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
            batch.share(batch.job, store, batch.key, batch.items, **batch.arguments)
    except Exception as error:
        return _failed(batch.number, error)
    ended = time.monotonic()
    return Answer(number=batch.number, seconds=ended - loaded, loading_seconds=loaded - started, usage=usage)


def _failed(number: int, error: Exception) -> Answer:
    """The answer that tells of an error: the sentence of one that a user can act on, the traceback of any other."""
    if isinstance(error, OSError) and error.errno is not None:
        where = f" ({error.filename})" if error.filename else ""
        return Answer(number=number, error="OSError", message=f"{error.strerror}{where}", errno=error.errno)
    kind = next((name for name, known in KNOWN_ERRORS.items() if isinstance(error, known)), type(error).__name__)
    return Answer(number=number, error=kind, message=str(error) if kind in KNOWN_ERRORS else traceback.format_exc())


def is_done(section: Section, marker: str, view: int, key: str, data: str | None = None) -> bool:
    """Whether a view is marked with exactly this content key, and (slower) whether its chunk of `data` is whole."""
    try:
        done = bool(section.read(marker, [view])[0].tobytes().hex() == key)
        if done and data:
            section.read(data, [view])
        return done
    except StoreError:
        return False


class Sign(NamedTuple):
    """That a worker is at an item: `beat` changes while it lives; done of total units, and a remark."""

    beat: int
    done: int
    total: int
    note: str


class Work(ABC):
    """One stage of one job to be shared out: items in passes, one pass after another; what is done stands in the store.

    load, share: functions of a module (not of another function), as a worker finds them by name; arguments: further
    ones of `share`, as JSON values. needs: what an item asks of its worker.
    """

    def __init__(
        self, job: Job, stage: str, key: str, needs: Needs, load: Load, share: Share, passes: Sequence[Sequence[int]],
        arguments: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self.job, self.stage, self.key, self.needs, self.load, self.share = job, stage, key, needs, load, share
        self.passes = [list(items) for items in passes]
        self.arguments = dict(arguments or {})

    def batch(self, number: int, items: Sequence[int]) -> Batch:
        """Some of the items, to be sent to a worker."""
        return Batch(
            number=number, job=self.job, stage=self.stage, key=self.key, items=tuple(items), load=self.load,
            share=self.share, needs=self.needs, arguments=self.arguments,
        )  # fmt: skip

    @abstractmethod
    def size(self, items: Iterable[int]) -> int:
        """Units of progress that the items are."""

    @abstractmethod
    def finished(self, item: int) -> bool:
        """Whether the store says that the item is done; cheap, for watching."""

    def sign(self, item: int) -> Sign | None:
        """The last sign of life of a worker that is at the item; None where only finished items are one."""
        return None


class ViewMarks(NamedTuple):
    """Views whose content keys in the array `marker` of the section say what is done; `data` is read to make sure."""

    section: Section
    marker: str
    data: str
    keys: Sequence[str]


class ViewWork(Work):
    """Items that make views: those of item i are views[i]. Only items with a view that isn't done are in its passes."""

    def __init__(
        self, job: Job, stage: str, key: str, needs: Needs, load: Load, share: Share, marks: ViewMarks,
        passes: Sequence[Sequence[int]], views: Sequence[Sequence[int]],
    ) -> None:  # fmt: skip
        self.marks, self.views = marks, views
        super().__init__(job, stage, key, needs, load, share, [self.missing(items) for items in passes])

    def missing(self, items: Sequence[int]) -> list[int]:
        """Those of the items that have a view which isn't there whole and marked as done. Reads the data."""
        section, marker, data, keys = self.marks
        done = section.done(marker, keys, [data])
        return [i for i in items if not all(done[v] for v in self.views[i])]

    def size(self, items: Iterable[int]) -> int:
        """How many views they make."""
        return sum(len(self.views[i]) for i in items)

    def finished(self, item: int) -> bool:
        """Whether all views of the item are marked as done."""
        section, marker, _, keys = self.marks
        return all(is_done(section, marker, v, keys[v]) for v in reversed(self.views[item]))
