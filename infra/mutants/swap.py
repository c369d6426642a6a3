"""Putting a mutant in the place of the living function: its code object is swapped, so that all who hold it run it."""

from __future__ import annotations

import functools
import gc
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CORE = str(ROOT / "cat3d_core")


class Unusable(ValueError):
    """The mutant cannot be put in place: the source has changed, or its code is what it was."""


def function_name(code: CodeType) -> tuple[str, str]:
    """(File from the root of the project, function or method that stands in its module) of a code object."""
    return code.co_filename.removeprefix(f"{ROOT}/"), code.co_qualname.split(".<locals>")[0]


class Living:
    """All functions of cat3d_core that are in memory, by where their code comes from."""

    def __init__(self) -> None:
        self._by_code: dict[tuple[str, str, int], list[FunctionType]] = defaultdict(list)
        self._caches: list[Any] = []
        for thing in gc.get_objects():
            if type(thing) is FunctionType and thing.__code__.co_filename.startswith(CORE):
                self._by_code[_key(thing.__code__)].append(thing)
            elif type(thing) is functools._lru_cache_wrapper and str(thing.__module__).startswith("cat3d_core"):
                self._caches.append(thing)

    def swap(self, mutant: dict[str, Any]) -> None:
        """Put the mutant in place, for good (this process ends with it), and forget what functions had cached.

        Raises Unusable where the file no longer has the lines that it changes, where the compiler makes the same of
        both, or where it changes which outer variables the function sees."""
        path = ROOT / mutant["file"]
        source = path.read_text().splitlines()
        at, old = mutant["start"] - 1, mutant["old"]
        if source[at : at + len(old)] != old:
            raise Unusable("stale")
        changed = [*source[:at], *mutant["new"], *source[at + len(old) :]]
        before = _codes("\n".join(source), path, mutant["function"])
        after = _codes("\n".join(changed), path, mutant["function"])
        pairs = [(a, b) for a, b in zip(before, after, strict=True) if _content(a) != _content(b)]
        if not pairs:
            raise Unusable("same")
        for a, b in pairs:
            functions = self._by_code[_key(a)]
            if not functions or a.co_freevars != b.co_freevars:
                raise Unusable("cannot be swapped")
            for function in functions:
                function.__code__ = b
        for cache in self._caches:
            cache.cache_clear()


def _codes(source: str, path: Path, name: str) -> list[CodeType]:
    """Code objects of that name: several for a property with a setter, or a function defined twice."""
    module = compile(source, str(path), "exec", dont_inherit=True)
    return [code for code in _nested(module) if code.co_qualname == name]


def _nested(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _nested(constant)


def _key(code: CodeType) -> tuple[str, str, int]:
    return code.co_filename, code.co_qualname, code.co_firstlineno


def _content(code: CodeType) -> tuple[Any, ...]:
    """What a code object does, wherever it stands; constants by their repr, since 1 == 1.0 == True and 0.0 == -0.0."""
    constants = [_content(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
