"""Deliberate faults, the kind that numerical code is full of: each one breaks a bound of `cat3d stress --quick`.

A mutation replaces a piece of a function's source and swaps the code of the living function object, so that everything
that holds the function (the stress routines too) runs the fault.
"""

from __future__ import annotations

import contextlib
import inspect
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import typer

from cat3d_core import alignment, cameras, rays, splines
from cat3d_core.diffusion import guidance, schedule, solvers
from cat3d_core.metrics import psnr, ssim
from cat3d_core.reconstruction import render as image_render
from cat3d_core.splats import density, reference
from cat3d_core.stress import ROUTINES, stress
from cat3d_core.zipnerf import adam, coordinates, frustums, gradients, grid_reference, losses, ray_intervals, stepfun
from flows.commands.stress import QUICK_CASES, stress_command


@contextlib.contextmanager
def mutated(function: Callable[..., Any], changes: dict[str, str]) -> Iterator[None]:
    """`function` with pieces of its source replaced, until the block ends."""
    function = inspect.unwrap(function)
    source = textwrap.dedent(inspect.getsource(function))
    for old, new in changes.items():
        assert old in source, f"{function.__name__} no longer contains {old!r}; adapt the mutation."
        source = source.replace(old, new)
    lines = [line for line in source.splitlines() if not line.startswith("@")]
    scope = dict(function.__globals__)
    exec(
        compile("from __future__ import annotations\n" + "\n".join(lines), f"<mutated {function.__name__}>", "exec"),
        scope,
    )
    sound = function.__code__
    function.__code__ = scope[function.__name__].__code__
    try:
        yield
    finally:
        function.__code__ = sound


MUTATIONS: dict[str, tuple[Callable[..., Any], dict[str, str], str]] = {
    "thin fog lost by 1 - exp(-x)": (
        ray_intervals.weights_reference,
        {"-torch.expm1(-depth)": "(1 - torch.exp(-depth))"},
        "render.weights_from_density",
    ),
    "eps outside the square root": (
        losses.charbonnier,
        {"(difference.square() + eps * eps).sqrt()": "difference.square().sqrt() + eps"},
        "losses.charbonnier",
    ),
    "SSIM in float32": (
        ssim._local_ssim,
        {"prediction, target = prediction.double(), target.double()": "pass"},
        "ssim.ssim[",
    ),
    "log of zero": (psnr.psnr, {"error.clamp_min(tiny)": "error"}, "psnr.psnr"),
    "division by the norm in the contraction": (
        coordinates.contract,
        {
            "x.square().sum(-1, keepdim=True).clamp_min(1.0)": "x.norm(dim=-1, keepdim=True).square()",
            "return x *": "return torch.where(squared <= 1, x, 1.0) *",
        },
        "coordinates.contract",
    ),
    "power of a negative base": (
        coordinates.contracted_std,
        {"(2.0 * radius - 1.0).pow(2.0 / 3.0)": "(1.0 - 2.0 * radius).pow(2.0 / 3.0)"},
        "coordinates.contracted_std",
    ),
    "plain power ladder": (
        coordinates.power_ladder,
        {"torch.expm1(p * torch.log1p(x / scale))": "((x / scale + 1) ** p - 1)"},
        "coordinates.power_ladder",
    ),
    "plain inverse of the ray distance": (
        coordinates.t_from_s,
        {"low = s < 0.5": "low = s < 0.0"},
        "coordinates.t_from_s[0..1e+06",
    ),
    "acos without clamp": (
        alignment.rotation_angle_deg,
        {"torch.asin(chord.clamp(max=1))": "torch.acos(((a * b).sum((-2, -1)) - 1) / 2) / 2"},
        "alignment.rotation_angle_deg",
    ),
    "small turns by acos of the trace": (
        splines.so3_log,
        {"2 * torch.atan2(size, real)": "2 * torch.acos(real.clamp(max=1))"},
        "splines.so3_log",
    ),
    "softmax without its maximum": (
        stepfun.invert_cdf,
        {"torch.softmax(logits, -1)": "(logits.exp() / logits.exp().sum(-1, keepdim=True))"},
        "stepfun.invert_cdf",
    ),
    "division by a bin's width without guard": (
        stepfun.pdf_from_weights,
        {"w / torch.where(positive, width, 1.0)": "w / width"},
        "stepfun.pdf_from_weights",
    ),
    "blur in single precision": (
        stepfun.blurred_resample,
        {"t.double(), w.double(), query.double()": "t, w, query"},
        "stepfun.blurred_resample",
    ),
    "difference of middles": (
        stepfun.distortion,
        {"gap = 0.5 * (width[..., 1:] + width[..., :-1])": "gap = (0.5 * (t[..., 1:] + t[..., :-1])).diff(dim=-1)"},
        "stepfun.distortion",
    ),
    "centre of an interval at 0": (
        frustums.sample_distances,
        {"centre.clamp_min(torch.finfo(t.dtype).tiny)": "centre"},
        "frustums.sample_distances",
    ),
    "sign of zero": (
        rays.perpendicular_basis,
        {"torch.where(z < 0, -1.0, 1.0).to(z.dtype)": "z.sign()"},
        "rays.perpendicular_basis",
    ),
    "density without cap": (
        gradients._SafeExp.forward,
        {"x.clamp_max(_LOG_DENSITY_MAX).exp()": "x.exp()"},
        "field.safe_exp",
    ),
    "step lengths squared and multiplied": (
        image_render.normals_from_depth,
        {"torch.linalg.cross(tangent(0), tangent(1))": "torch.linalg.cross(tangent(0) * 1e12, tangent(1) * 1e12)"},
        "render.normals_from_depth",
    ),
    "corners outside the grid": (
        grid_reference._corner,
        {"inside = (x >= 0)": "inside = (x >= -1)"},
        "hash_grid.query_reference[dense]",
    ),
    "depth not clamped": (cameras.Cameras.project, {"depth.clamp(min=tiny)": "depth"}, "cameras.project"),
    "usual eps in Adam": (adam.Adam.step, {"eps = self.eps": "eps = 1e-8"}, "adam.Adam"),
    "amplitude by 1 - alpha^2": (
        schedule.alpha_sigma,
        {"torch.sigmoid(-log_snr).sqrt()": "(1 - torch.sigmoid(log_snr)).sqrt()"},
        "schedule.alpha_sigma",
    ),
    "half precision state": (
        solvers.Solver._first_order,
        {"return gain * x +": "x = x.half().to(x.dtype); return gain * x +"},
        "solvers.ddim",
    ),
    "determinant of an image by a difference": (
        reference.project,
        {"torch.linalg.cross(factor[:, 0], factor[:, 1]).square().sum(-1)": "xx * yy - xy * xy"},
        "splats.project",
    ),
    "root of a small opacity's rest": (
        density.split,
        {"torch.log1p(-opacity)": "(1 - opacity).log()"},
        "splats.split",
    ),
    "guidance at scale 1": (guidance.GuidanceConfig.active, {"self.scale != 1.0 and": ""}, "guidance.guided"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_fault_breaks_a_bound(name: str) -> None:
    function, changes, only = MUTATIONS[name]
    routines = [routine for routine in ROUTINES if only in routine.name]
    with mutated(function, changes):
        findings = stress(routines, QUICK_CASES)
    assert any(not finding.ok for finding in findings), f"nothing noticed: worst {max(f.error for f in findings):.2e}"


def test_command_fails_on_a_fault(capsys: pytest.CaptureFixture[str]) -> None:
    function, changes, only = MUTATIONS["thin fog lost by 1 - exp(-x)"]
    with mutated(function, changes), pytest.raises(typer.Exit) as stop:
        stress_command(quick=True, only=only)
    assert stop.value.exit_code == 1
    out = capsys.readouterr().out
    assert "BROKEN" in out.strip().splitlines()[-1]
    assert "relative error" in out
    stress_command(quick=True, only=only)  # sound again
