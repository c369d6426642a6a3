"""Small faults for the functions of cat3d_core: the operators of mutmut, and some that tensors ask for.

Runs in an environment of its own (`make mutants` makes it), reads sources only, and writes one mutant a line. Mutated
are the bodies of functions and methods. Not mutated: docstrings, f-strings, strings with a space (messages),
annotations, defaults, decorators, what stands in `raise`, `assert`, `warnings.warn` and under TYPE_CHECKING. Left out
of mutmut's operators are those that almost any call notices: None for an argument or a value, a positional argument
left out, and changes of a string's case.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libcst as cst
import libcst.matchers as m
from libcst.metadata import MetadataWrapper, PositionProvider
from mutmut.mutation import mutators

ROOT = Path(__file__).resolve().parents[2]
#: Not of the sample: the search for worst inputs, which is itself a test; kernels that only run on a GPU.
LEFT_OUT = ("cat3d_core/stress/", "cat3d_core/zipnerf/hash_grid_triton.py", "cat3d_core/splats/rasterize_gsplat.py")

_PAIRS = (
    "min max", "minimum maximum", "amin amax", "argmin argmax", "clamp_min clamp_max", "any all", "floor ceil",
    "sin cos",
    "zeros ones", "zeros_like ones_like", "exp expm1", "log log1p", "sum mean", "cumsum cumprod", "square abs",
    "logical_and logical_or", "sqrt square",
)  # fmt: skip
_SWAPS = {a: b for pair in _PAIRS for a, b in (pair.split(), reversed(pair.split()))}


@dataclass(frozen=True)
class Found:
    """One mutant: a node of a module, and what replaces it."""

    function: str
    line: int
    operator: str
    old: cst.CSTNode
    new: cst.CSTNode


def tensor_call(node: cst.Call) -> Iterable[cst.Call]:
    """`x.min()` becomes `x.max()`, `torch.sin(x)` becomes `torch.cos(x)`, and so on."""
    name = node.func.attr if isinstance(node.func, cst.Attribute) else node.func
    if isinstance(name, cst.Name) and name.value in _SWAPS:
        yield node.with_deep_changes(name, value=_SWAPS[name.value])


def negated(node: cst.If | cst.While) -> Iterable[cst.CSTNode]:
    """The other branch."""
    test = node.test.with_changes(lpar=[cst.LeftParen()], rpar=[cst.RightParen()])
    yield node.with_changes(test=cst.UnaryOperation(cst.Not(), test))


def dropped(node: cst.Expr) -> Iterable[cst.CSTNode]:
    """A call for its effect, left out."""
    if isinstance(node.value, cst.Call):
        yield cst.Pass()


def missing_argument(node: cst.Call) -> Iterable[cst.Call]:
    """Each argument that is given by name left out: mostly its default takes its place."""
    for i, argument in enumerate(node.args):
        if argument.keyword is not None:
            yield node.with_changes(args=[*node.args[:i], *node.args[i + 1 :]])


def marked_string(node: cst.SimpleString) -> Iterable[cst.BaseString]:
    """A name with XX around it; messages (strings with a space) are left alone."""
    if " " not in node.value:
        yield from list(mutators.operator_string(node))[:1]


OPERATORS: tuple[tuple[Any, Any], ...] = (
    (cst.BaseNumber, mutators.operator_number),
    (cst.SimpleString, marked_string),
    (cst.Name, mutators.operator_name),
    (cst.AugAssign, mutators.operator_augmented_assignment),
    (cst.UnaryOperation, mutators.operator_remove_unary_ops),
    (cst.Call, missing_argument),
    (cst.Call, mutators.operator_symmetric_string_methods_swap),
    (cst.Call, tensor_call),
    (cst.CSTNode, mutators.operator_keywords),
    (cst.CSTNode, mutators.operator_swap_op),
    (cst.IfExp, mutators.operator_if_exp),
    ((cst.If, cst.While), negated),
    (cst.Expr, dropped),
)
_SILENT = m.Raise() | m.Assert() | m.Annotation() | m.Decorator() | m.FormattedString() | m.Parameters()
_NOT_CALLED = m.Call(func=m.Name("isinstance") | m.Attribute(m.Name("warnings"), m.Name("warn")))


class _Finder(cst.CSTVisitor):
    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self) -> None:
        super().__init__()
        self.scope: list[tuple[str, bool]] = []  # names of classes and functions, and whether it is a function
        self.found: list[Found] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        if m.matches(node, _SILENT) or m.matches(node, _NOT_CALLED) or _is_docstring(node) or _is_for_types(node):
            return False
        if isinstance(node, cst.FunctionDef | cst.ClassDef):
            self.scope.append((node.name.value, isinstance(node, cst.FunctionDef)))
        elif any(is_function for _, is_function in self.scope):
            self._mutate(node)
        return True

    def on_leave(self, original_node: cst.CSTNode) -> None:
        if isinstance(original_node, cst.FunctionDef | cst.ClassDef):
            self.scope.pop()

    def _mutate(self, node: cst.CSTNode) -> None:
        first = next(i for i, (_, is_function) in enumerate(self.scope) if is_function)
        function = ".".join(name for name, _ in self.scope[: first + 1])
        for kind, operator in OPERATORS:
            if isinstance(node, kind):
                line = self.get_metadata(PositionProvider, node).start.line
                for new in operator(node):
                    self.found.append(Found(function, line, operator.__name__, node, new))


def _is_docstring(node: cst.CSTNode) -> bool:
    return m.matches(node, m.SimpleStatementLine([m.Expr(m.SimpleString() | m.ConcatenatedString())]))


def _is_for_types(node: cst.CSTNode) -> bool:
    return m.matches(node, m.If(test=m.Name("TYPE_CHECKING")))


def mutants(path: Path, count: int, seed: int) -> Iterator[dict[str, Any]]:
    """`count` mutants of a file, all where there are fewer, drawn without putting back; the draw hangs on the seed
    and the file's name alone. The dictionary's `old` lines from `start` (1 is the first) become the `new` ones."""
    name = path.relative_to(ROOT).as_posix()
    wrapper = MetadataWrapper(cst.parse_module(path.read_text()))
    finder = _Finder()
    wrapper.visit(finder)
    source = wrapper.module.code.splitlines()
    found = finder.found
    random.Random(f"{seed} {name}").shuffle(found)
    seen: set[str] = set()
    for mutant in found:
        if len(seen) >= count:
            return
        code = wrapper.module.deep_replace(mutant.old, mutant.new).code  # type: ignore[arg-type]
        if code in seen or not _compiles(code):
            continue
        seen.add(code)
        start, old, new = difference(source, code.splitlines())
        text = f"{name} {mutant.function} {mutant.operator} {old} {new} {start}"
        yield {
            "id": hashlib.sha256(text.encode()).hexdigest()[:12], "file": name, "function": mutant.function,
            "line": mutant.line, "operator": mutant.operator.removeprefix("operator_"),
            "start": start, "old": old, "new": new, "of": len(found),
        }  # fmt: skip


def difference(before: list[str], after: list[str]) -> tuple[int, list[str], list[str]]:
    """The first line that differs (counted from 1), and the lines there before and after."""
    head = 0
    while head < min(len(before), len(after)) and before[head] == after[head]:
        head += 1
    tail = 0
    while tail < min(len(before), len(after)) - head and before[-1 - tail] == after[-1 - tail]:
        tail += 1
    return head + 1, before[head : len(before) - tail], after[head : len(after) - tail]


def _compiles(code: str) -> bool:
    try:
        compile(code, "mutant", "exec")
    except (SyntaxError, ValueError):
        return False
    return True


def main() -> None:
    """Write the sample: first one mutant of each file, then a second one of each, ..., so that a run that is stopped
    early has drawn evenly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="cat3d_core", help="a file or folder")
    parser.add_argument("--count", type=int, default=25, help="mutants of each file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    given = ROOT / options.only
    files = sorted(given.rglob("*.py")) if given.is_dir() else [given]
    files = [file for file in files if not file.relative_to(ROOT).as_posix().startswith(LEFT_OUT)]
    drawn = [list(mutants(file, options.count, options.seed)) for file in files]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [rank[i] for i in range(options.count) for rank in drawn if i < len(rank)]
    options.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print(f"{len(rows)} mutants of {sum(rank[0]['of'] for rank in drawn if rank)} possible ones, {len(files)} files")


if __name__ == "__main__":
    main()
