"""The search itself, the routines' references against mpmath, and `cat3d stress --quick`."""

from __future__ import annotations

import dataclasses
import json
import math

import mpmath
import pytest
import torch
import typer

from cat3d_core.diffusion import ScheduleConfig
from cat3d_core.diffusion.schedule import Schedule
from cat3d_core.stress import ROUTINES, Routine, stress
from cat3d_core.stress.draw import Draw
from cat3d_core.stress.routine import Exact
from cat3d_core.stress.search import measure
from flows.commands.stress import QUICK_CASES, stress_command


def _named(name: str) -> Routine:
    return next(routine for routine in ROUTINES if routine.name == name)


@pytest.mark.parametrize("routine", ROUTINES, ids=lambda routine: routine.name)
def test_bounds_hold(routine: Routine) -> None:
    for finding in stress([routine], QUICK_CASES // 4, seed=1):
        assert finding.ok, f"{finding.dtype} {finding.kind}: {finding.error:.2e} > {finding.bound:.0e} {finding}"


def test_names_are_unique_and_every_dtype_has_a_gradient_bound_only_where_it_has_a_value_bound() -> None:
    assert len({routine.name for routine in ROUTINES}) == len(ROUTINES)
    for routine in ROUTINES:
        assert set(routine.gradients or {}) <= set(routine.bounds), routine.name


def test_search_is_repeatable_and_depends_on_the_seed() -> None:
    routine = _named("coordinates.contract")
    first, again, other = (stress([routine], 200, seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_search_finds_a_needle() -> None:
    """A fault in a small part of the range, whose error grows towards it, is found by moving the worst cases."""
    base = _named("losses.charbonnier")

    def faulty(d: torch.Tensor) -> torch.Tensor:
        return base.call(d) * (1 + 1e-3 * torch.exp(-((d.abs().log() - 2.0) ** 2) * 10))

    (found,) = stress([dataclasses.replace(base, call=faulty, gradients=None)], 3000)
    assert found.error == pytest.approx(1e-3, rel=0.01)
    assert abs(found.input["0:()"][0]) == pytest.approx(math.exp(2), rel=0.1)


def test_nan_infinity_and_errors_are_findings() -> None:
    base = _named("losses.charbonnier")
    for call in (lambda d: d / d * d.abs(), lambda d: 1 / d, lambda d: base.call(d)[:0]):
        findings = stress([dataclasses.replace(base, call=call, gradients=None)], 2000)
        assert not any(finding.ok for finding in findings)
    (found,) = stress([dataclasses.replace(base, call=lambda d: d.view(-1, 7), gradients=None)], 100)
    assert "RuntimeError" in found.fault


def test_the_worst_input_that_is_reported_gives_the_error() -> None:
    routine = _named("hash_grid.level_weights")
    finding = next(f for f in stress([routine], 2000) if f.dtype == "float32")
    value = torch.tensor(finding.input["0:()"], dtype=torch.float64)
    assert measure(routine, torch.float32, (value,))["value"].item() == finding.error


def _mp_ladder(x: float, p: float, premult: float) -> mpmath.mpf:
    y = mpmath.mpf(x) * premult
    if p == 0.0:
        return mpmath.log1p(y)
    if p == -math.inf:
        return 1 - mpmath.exp(-y)
    c = abs(mpmath.mpf(p) - 1)
    return c / p * ((y / c + 1) ** p - 1)


@pytest.mark.parametrize(("p", "premult"), [(-1.5, 2.0), (-0.25, 1e4), (0.0, 1.0), (0.5, 1.0), (-math.inf, 1.0)])
def test_reference_of_the_ladder(p: float, premult: float) -> None:
    _against_mpmath(f"coordinates.power_ladder[{p:g}]", lambda x: _mp_ladder(x, p, premult))


def _mp_distance(s: float, near: float, far: float, p: float) -> mpmath.mpf:
    near, far = mpmath.mpf(near), mpmath.mpf(far)
    c = abs(mpmath.mpf(p) - 1) / 2
    if p == 1.0:
        return near + s * (far - near)

    def ladder(t: mpmath.mpf) -> mpmath.mpf:
        return mpmath.log(1 + t / c) if p == 0 else (1 + t / c) ** p

    mixed = (1 - mpmath.mpf(s)) * ladder(near) + mpmath.mpf(s) * ladder(far)
    return c * (mpmath.exp(mixed) - 1 if p == 0 else mixed ** (1 / mpmath.mpf(p)) - 1)


@pytest.mark.parametrize(
    ("near", "far", "p"), [(0.0, 1e6, -1.5), (0.1, 1e6, -1.5), (0.0, 1e12, -1.5), (0.2, 1e3, 0.0), (1e-3, 10.0, 1.0)]
)
def test_reference_of_the_distance(near: float, far: float, p: float) -> None:
    name = f"coordinates.t_from_s[{near:g}..{far:g},p={p:g}]"
    _against_mpmath(name, lambda s: _mp_distance(s, near, far, p), 1e-10)


def test_references_of_one_number() -> None:
    half = mpmath.mpf(1) / 2
    _against_mpmath("losses.charbonnier", lambda d: mpmath.sqrt(mpmath.mpf(d) ** 2 + mpmath.mpf(1e-3) ** 2))
    _against_mpmath(
        "hash_grid.level_weights",
        lambda s: mpmath.erf(1 / (mpmath.sqrt(8) * 512 * mpmath.mpf(s))) if s else mpmath.mpf(1),
    )
    _against_mpmath("field.safe_exp", lambda x: mpmath.exp(min(x, 40.0)))
    _against_mpmath(
        "schedule.alpha_sigma",
        lambda x: (1 / (1 + mpmath.exp(-mpmath.mpf(x)))) ** half if math.isfinite(x) else None,
        column=0,
    )


@pytest.mark.parametrize("base", ["cosine", "scaled_linear", "linear"])
@pytest.mark.parametrize("terminal", [True, False])
def test_schedule_tables(base: str, terminal: bool) -> None:
    """The definitions of the tables in 60 digits, the shift by the logarithm of the number of targets included."""
    config = ScheduleConfig(base=base, zero_terminal_snr=terminal)  # type: ignore[arg-type]
    with mpmath.workdps(60):
        count = config.steps
        first, last = mpmath.mpf(config.beta_start), mpmath.mpf(config.beta_end)
        line = [mpmath.mpf(i) / (count - 1) for i in range(count)]
        if base == "cosine":
            offset, whole = mpmath.mpf("0.008"), mpmath.mpf("1.008")
            curve = [
                mpmath.cos((mpmath.mpf(i) / count + offset) / whole * mpmath.pi / 2) ** 2 for i in range(count + 1)
            ]
            betas = [min(1 - curve[i + 1] / curve[i], mpmath.mpf("0.999")) for i in range(count)]
        elif base == "scaled_linear":
            betas = [(mpmath.sqrt(first) + x * (mpmath.sqrt(last) - mpmath.sqrt(first))) ** 2 for x in line]
        else:
            betas = [first + x * (last - first) for x in line]
        signal, product = [], mpmath.mpf(1)
        for beta in betas:
            product *= 1 - beta
            signal.append(mpmath.sqrt(product))
        if terminal:
            scale = signal[0] / (signal[0] - signal[-1])
            signal = [(x - signal[-1]) * scale for x in signal]
        exact = [float(mpmath.log(x**2 / (1 - x**2)) - mpmath.log(7)) if x else -math.inf for x in signal]
    got = Schedule(config, 7).log_snr
    torch.testing.assert_close(got, torch.tensor(exact, dtype=torch.float64), rtol=1e-11, atol=1e-11)


def _against_mpmath(name: str, exact: object, tolerance: float = 1e-12, column: int | None = None) -> None:
    """The routine's float64 reference at 300 drawn inputs, against 60 digits."""
    routine = _named(name)
    (inputs,) = routine.inputs(Draw(300, torch.Generator().manual_seed(0), torch.finfo(torch.float32).tiny))
    value = routine.reference(inputs)
    value = value.value if isinstance(value, Exact) else value
    value = value if column is None else value[:, column]
    with mpmath.workdps(60):
        for x, got in zip(inputs.tolist(), value.tolist(), strict=True):
            true = exact(x)  # type: ignore[operator]
            if true is not None:
                assert abs(got - true) <= tolerance * abs(true) + 1e-300, f"{name} at {x}: {got} is not {true}"


def test_command_prints_a_table_and_sums_up(capsys: pytest.CaptureFixture[str]) -> None:
    stress_command(quick=True, only="losses.charbonnier")
    lines = capsys.readouterr().out.strip().splitlines()
    assert "charbonnier" in lines[-2]
    assert "all 2 bounds hold" in lines[-1]


def test_command_json(capsys: pytest.CaptureFixture[str]) -> None:
    stress_command(quick=True, as_json=True, only="losses.charbonnier")
    document = json.loads(capsys.readouterr().out)
    assert [row["kind"] for row in document["findings"]] == ["value", "gradient"]
    assert all(row["ok"] for row in document["findings"])


def test_command_refuses_unknown_names(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as stop:
        stress_command(quick=True, only="nothing like this")
    assert stop.value.exit_code == 2
    assert "no routine" in capsys.readouterr().out
