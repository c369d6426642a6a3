"""A job's generator: which kind it is, what it is like, and one loaded copy of it in each process.

The only place that knows kinds of model files. A package of someone else's brings one through an entry point of the
group `cat3d.generators` (docs/guides/own_generator.md).
"""

from __future__ import annotations

import functools
import importlib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, cast

from cat3d_core.generation import Generator, GeneratorSpec
from flows.errors import InputError
from flows.jobs.device import device, free_device_memory
from flows.jobs.job import Job

GROUP = "cat3d.generators"
#: The one without a file.
DEFAULT = "cat3d"
#: Our own formats, in the order in which they are tried: names in `flows/generation/formats/`.
FORMATS = ("seva", "cat3d")


class Format(Protocol):
    """A kind of model file and how it becomes a generator: a module or any other object with these names."""

    #: A phrase on what `recognises` looks for.
    LOOKS_FOR: str

    def recognises(self, path: Path) -> bool:
        """Whether a file or folder is of this kind. Cheap, and False for what can't be read."""
        ...

    def describe(self, path: Path | None) -> GeneratorSpec:
        """What the generator is, without its weights; None: the one that needs no file. Raises ValueError."""
        ...

    def load(self, path: Path | None, device: str, precision: str) -> Generator:
        """The generator on a torch device, its network in a precision ("float32", "bfloat16"). Raises ValueError."""
        ...


def generator_spec(job: Job) -> GeneratorSpec:
    """What the job's generator is, without loading it, for windows and images of the sizes that the plan asks for.
    Raises InputError for a model that can't be used, or not with them."""
    name, path = _kind(job)
    spec, plan = _described(name, path, _changed(path)), job.config.plan
    if spec.at is None:
        if plan.window is not None:
            raise InputError(f"plan.window is set, but the generator {name} always takes {spec.views} views at once.")
        return spec
    try:
        return spec.at(plan.window, plan.image_size)
    except ValueError as error:
        raise InputError(f"plan.window, plan.image_size: {error}") from None


def open_generator(job: Job) -> Generator:
    """The job's generator on this process's device; loaded once a process. Raises InputError."""
    name, path = _kind(job)
    generator, spec = _loaded(name, path, _changed(path), device(), job.config.sample.precision), generator_spec(job)
    if generator.spec != spec:
        generator.spec = spec
    return generator


def forget_generator() -> None:
    """Free the memory of this process's generator."""
    _loaded.cache_clear()
    free_device_memory()


def find_format(name: str) -> Format:
    """The format of this name, ours or an installed package's. Raises InputError where there is none."""
    if name in FORMATS:
        return cast(Format, importlib.import_module(f"flows.generation.formats.{name}"))
    others = {point.name: point for point in entry_points(group=GROUP)}
    if name not in others:
        known = ", ".join([*FORMATS, *sorted(others)])
        raise InputError(f"sample.generator: there is no generator {name!r}; installed are {known}.")
    return cast(Format, others[name].load())


def format_names() -> list[str]:
    """Names of all formats: ours, then those of installed packages."""
    return [*FORMATS, *sorted({point.name for point in entry_points(group=GROUP)} - set(FORMATS))]


def recognised(path: Path) -> str:
    """Name of the first format that recognises a file or folder. Raises InputError where none does."""
    looked_for = []
    for name in format_names():
        kind = find_format(name)
        if kind.recognises(path):
            return name
        looked_for.append(f"  {name}: {kind.LOOKS_FOR}")
    raise InputError(
        f"sample.checkpoint: {path} is no model that a generator recognises, or it is damaged. Looked for:\n"
        + "\n".join(looked_for)
    )


def _kind(job: Job) -> tuple[str, Path | None]:
    """The format of the job's generator and its resolved path."""
    name, path = job.config.sample.generator, job.config.sample.checkpoint
    if path is None:
        return name or DEFAULT, None
    if not path.exists():
        raise InputError(f"sample.checkpoint: there is no model file {path}.")
    path = path.resolve()
    return name or _recognised(path, _changed(path)), path


def _changed(path: Path | None) -> int:
    """When a file, or the newest file of a folder, was changed, in nanoseconds."""
    if path is None:
        return 0
    files = [path, *(f for f in path.rglob("*") if f.is_file())] if path.is_dir() else [path]
    return max(file.stat().st_mtime_ns for file in files)


@functools.lru_cache(maxsize=4)
def _recognised(path: Path, _changed: int) -> str:
    return recognised(path)


@functools.lru_cache(maxsize=4)
def _described(name: str, path: Path | None, _changed: int) -> GeneratorSpec:
    try:
        spec = find_format(name).describe(path)
    except ValueError as error:
        raise _unusable(name, path, error) from None
    if spec.image_size[0] != spec.image_size[1]:
        raise InputError(f"The generator {name} makes images of {spec.image_size} pixels; samples are square here.")
    return spec


@functools.lru_cache(maxsize=1)
def _loaded(name: str, path: Path | None, _changed: int, where: str, precision: str) -> Generator:
    try:
        return find_format(name).load(path, where, precision)
    except ValueError as error:
        raise _unusable(name, path, error) from None


def _unusable(name: str, path: Path | None, error: ValueError) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{'sample.checkpoint' if path else f'sample.generator {name}'}: {error}")
