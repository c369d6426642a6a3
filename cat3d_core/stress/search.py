"""The search for the input on which a routine is worst."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import Exact, Routine

# Of the cases of a routine this share is drawn at random; the others are moves of the worst seen so far.
_EXPLORE = 0.7
_KEPT = 24  # worst cases kept to move from
_SHOWN = 12  # numbers of an input that are reported


@dataclass(frozen=True)
class Finding:
    """The worst case of one routine, dtype and kind ('value' or 'gradient'). error is relative (inf: a NaN or infinity
    that the reference does not have); input holds the arguments of the worst case; fault says what was raised."""

    routine: str
    dtype: str
    kind: str
    cases: int
    error: float
    bound: float
    input: dict[str, list[float]]
    fault: str = ""

    @property
    def ok(self) -> bool:
        return not self.fault and self.error <= self.bound


def stress(
    routines: Sequence[Routine],
    cases: int,
    seed: int = 0,
    on_finding: Callable[[Finding], None] | None = None,
) -> list[Finding]:
    """Search every routine with `cases` times its share cases per dtype; one finding per routine, dtype and kind.

    The numbers drawn for a routine depend on (seed, its name, the dtype) alone. `on_finding` hears of each in turn.
    """
    findings = []
    for routine in routines:
        for dtype in routine.bounds:
            for finding in _search(routine, dtype, max(8, round(cases * routine.share)), seed):
                findings.append(finding)
                if on_finding is not None:
                    on_finding(finding)
    return findings


def _search(routine: Routine, dtype: torch.dtype, cases: int, seed: int) -> Iterator[Finding]:
    text = f"{seed}/{routine.name}/{dtype}"
    generator = torch.Generator().manual_seed(int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big"))
    bounds = {"value": routine.bounds[dtype]}
    if routine.gradients and dtype in routine.gradients:
        bounds["gradient"] = routine.gradients[dtype]
    worst: dict[str, tuple[Tensor, Tensor]] = {}  # kind -> errors (k,), columns (k, n), worst first
    done, fault = 0, ""
    for count, columns in _plan(routine, cases, worst, generator):
        draw = Draw(count, generator, torch.finfo(dtype).tiny, columns() if columns is not None else None)
        try:
            errors = measure(routine, dtype, routine.inputs(draw))
        except (ValueError, RuntimeError, ArithmeticError, IndexError, AssertionError) as error:
            fault = f"{count} cases: {type(error).__name__}: {error}"
            break
        done += count
        for kind, sizes in errors.items():
            old_sizes, old_columns = worst.get(kind, (sizes[:0], draw.columns[:0]))
            joined = torch.cat([old_sizes, sizes])
            best = joined.argsort(descending=True, stable=True)[:_KEPT]
            worst[kind] = joined[best], torch.cat([old_columns, draw.columns])[best]
    for kind, bound in bounds.items():
        if kind not in worst or not len(worst[kind][0]):
            yield Finding(routine.name, _name(dtype), kind, done, float("inf"), bound, {}, fault or "no case ran")
            continue
        errors_, columns_ = worst[kind]
        inputs = routine.inputs(Draw(1, generator, torch.finfo(dtype).tiny, columns_[:1]))
        yield Finding(routine.name, _name(dtype), kind, done, float(errors_[0]), bound, _describe(inputs, dtype), fault)


def _plan(
    routine: Routine, cases: int, worst: dict[str, tuple[Tensor, Tensor]], generator: torch.Generator
) -> Iterator[tuple[int, Callable[[], Tensor] | None]]:
    """Sizes of the batches, and where their points come from: none and one case, random ones, moved worst ones."""
    yield 0, None
    yield 1, None
    left = max(1, round(_EXPLORE * cases))
    while left > 0:
        yield min(left, routine.chunk), None
        left -= routine.chunk
    left = max(1, cases - round(_EXPLORE * cases))
    while left > 0:
        count = min(left, routine.chunk, max(64, cases // 20))
        yield count, lambda n=count: _moved(torch.cat([c for _, c in worst.values()]), n, generator)  # type: ignore[misc]
        left -= count


def _moved(columns: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Points near some of the given ones: one or a few coordinates moved by 1e-6 to 1, or drawn anew."""
    start = columns[torch.randint(len(columns), (count,), generator=generator)]

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    width = max(start.shape[1], 1)
    changed = rand(*start.shape) < torch.maximum(rand(count, 1), torch.tensor(1.5 / width))
    step = (2 * rand(*start.shape) - 1) * 10 ** (-6 * rand(count, 1))
    fresh = rand(count, 1) < 0.25
    moved = torch.where(fresh, rand(*start.shape), (start + step).clamp(0, 1 - 1e-16))
    return torch.where(changed, moved, start)


def measure(routine: Routine, dtype: torch.dtype, inputs: tuple[Tensor, ...]) -> dict[str, Tensor]:
    """Relative errors (cases,) of the value and, where claimed, of the gradient."""
    rounded = [x.to(dtype) if x.is_floating_point() else x for x in inputs]
    wide = [x.double() if x.is_floating_point() else x for x in rounded]
    gradient = routine.gradients is not None and dtype in routine.gradients and len(inputs[0]) > 0
    if gradient:
        for i in routine.wrt:
            rounded[i] = rounded[i].clone().requires_grad_()
            wide[i] = wide[i].clone().requires_grad_()
    with torch.set_grad_enabled(gradient):
        got, exact = routine.call(*rounded), routine.reference(*wide)
    value, scale = exact if isinstance(exact, Exact) else (exact, exact.abs())
    floor = routine.floor if routine.floor is not None else torch.finfo(dtype).tiny
    if len(inputs[0]) == 0:
        if got.shape[:1] != (0,):
            raise ValueError(f"No cases give a result of shape {tuple(got.shape)}.")
        return {}
    errors = {"value": relative_error(got.detach(), value.detach(), scale.detach(), floor)}
    if gradient:
        ours = torch.autograd.grad(_mixed(got), [rounded[i] for i in routine.wrt])
        theirs = torch.autograd.grad(_mixed(value), [wide[i] for i in routine.wrt])
        sizes = [_largest(b) for b in theirs]
        if routine.gradient_scale is not None:
            sizes = [_like(s.detach(), b) for s, b in zip(routine.gradient_scale(*wide), theirs, strict=True)]
        parts = [relative_error(a, b, s, floor) for a, b, s in zip(ours, theirs, sizes, strict=True)]
        errors["gradient"] = torch.stack(parts).amax(0)
    return errors


def _largest(gradient: Tensor) -> Tensor:
    """Each case's largest entry, (cases, 1, ...)."""
    return _like(gradient.abs().flatten(1).amax(1) if gradient.dim() > 1 else gradient.abs(), gradient)


def _like(scale: Tensor, gradient: Tensor) -> Tensor:
    return scale.view(*scale.shape, *[1] * (gradient.dim() - scale.dim()))


def _mixed(output: Tensor) -> Tensor:
    """A fixed weighted sum of each case's outputs, the same for the routine and its reference."""
    flat = output.flatten(1) if output.dim() > 1 else output[:, None]
    weight = torch.cos(1.0 + torch.arange(flat.shape[1], dtype=torch.float64))
    return (flat * weight.to(flat.dtype)).sum()


def relative_error(got: Tensor, value: Tensor, scale: Tensor, floor: float) -> Tensor:
    """Largest |got - value| / max(scale, floor) of each case, (cases,) float64.

    Equal values have no error, infinities included; NaN or another infinity than the reference's has error inf.
    """
    got = got.double()
    if value.dim() > 0 and got.shape != value.shape:
        raise ValueError(f"The result has shape {tuple(got.shape)}, the reference {tuple(value.shape)}.")
    error = (got - value).abs() / scale.clamp_min(floor)
    same = (got == value) | (got.isnan() & value.isnan())
    error = torch.where(same, 0.0, torch.where(got.isfinite(), error, torch.inf))
    error = torch.where(error.isnan(), torch.inf, error)
    return error.flatten(1).amax(1) if error.dim() > 1 else error


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _describe(inputs: tuple[Tensor, ...], dtype: torch.dtype) -> dict[str, list[float]]:
    """The first numbers of each argument, as the routine saw them."""
    return {
        f"{i}:{tuple(x.shape[1:])}": (x.to(dtype) if x.is_floating_point() else x).flatten()[:_SHOWN].double().tolist()
        for i, x in enumerate(inputs)
    }
