"""Solvers, nodes, guidance intervals and dtypes of the sampler: error against a 1,000-step float64 reference.

Two problems: `mixture`, whose exact v-prediction is known in closed form (error of solver and nodes alone), and
`model`, a model file on held-out procedural scenes. Error is the root mean square difference of the latents (unit
variance) from the reference with the same guidance. Evaluations count one group through the network once: guidance
costs a second one.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor, nn

from cat3d_core.diffusion import SIZES, GuidanceConfig, MultiViewModel, SamplerConfig, Schedule, load_model, sample
from cat3d_core.diffusion.config import ModelConfig
from cat3d_core.diffusion.sampler import evaluations
from cat3d_core.diffusion.schedule import Nodes, alpha_sigma
from cat3d_core.diffusion.solvers import SOLVERS
from cat3d_core.random import generator
from flows.bench import limits
from flows.bench.counts import counted, network_bytes

# Log-SNR intervals of guidance: everywhere, without the cleanest part, and without the noisiest part too.
INTERVALS = {"all": (-math.inf, math.inf), "below 2": (-math.inf, 2.0), "middle": (-5.0, 2.0)}
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
REFERENCE = ("dpm++", "log_snr", 1000)
Problem = tuple[MultiViewModel, Tensor, Tensor, Tensor]  # model, conditioning latents, cameras, noise


class MixtureNetwork(nn.Module):
    """Exact v of a mixture of Gaussians over all target latents of a group, `std` wide around random means.

    With a mask of zeros (the null condition) all means are possible, else the first third of them.
    """

    def __init__(
        self, config: ModelConfig, targets: int, shape: tuple[int, ...], modes: int = 9, std: float = 0.35
    ) -> None:
        super().__init__()
        self.schedule = Schedule(config.schedule, targets)
        self.targets, self.std, self.modes = targets, std, modes
        size = targets * math.prod(shape)
        means = torch.randn(modes, size, generator=generator(0, "mixture"), dtype=torch.float64)
        self.means = nn.Parameter(means * (1 - std**2) ** 0.5, requires_grad=False)

    def forward(
        self, latents: Tensor, time: Tensor, cameras: Tensor, mask: Tensor, hints: Tensor | None = None
    ) -> Tensor:
        dtype = self.means.dtype
        x = latents[:, -self.targets :].flatten(1).double()
        alpha, sigma = (float(s) for s in alpha_sigma(self._log_snr(float(time[0]))))
        variance = alpha**2 * self.std**2 + sigma**2
        means = self.means.double()
        logits = -(x[:, None] - alpha * means).square().sum(-1) / (2 * variance)
        given = mask.sum(1, keepdim=True) > 0
        excluded = torch.arange(self.modes) >= self.modes // 3
        weights = logits.masked_fill(given & excluded, -math.inf).softmax(-1)
        mean = weights @ means
        clean = mean + alpha * self.std**2 / variance * (x - alpha * mean)
        v = ((alpha * x - clean) / sigma).to(dtype)  # rounded as a network's output is
        return torch.cat(
            [latents[:, : -self.targets].to(dtype), v.unflatten(1, latents[:, -self.targets :].shape[1:])], 1
        )

    def _log_snr(self, step: float) -> Tensor:
        """The inverse of Schedule.time (input 'noise'): linear in log-SNR, in alpha just before pure noise."""
        table, last = self.schedule.base_log_snr, self.schedule.config.steps - 1
        low = min(int(step), last - 1)
        if torch.isinf(table[low + 1]):
            alpha = (last - step) * float(alpha_sigma(table[low])[0])
            return torch.tensor(2 * math.log(alpha) - math.log1p(-(alpha**2)) if alpha > 0 else -math.inf).double()
        return table[low] + (step - low) * (table[low + 1] - table[low])


def mixture_problem(groups: int = 64, given: int = 3) -> Problem:
    """Groups of 3 + 5 views with 8x4x4 latents (640 numbers) and the closed-form network."""
    config = SIZES["tiny"]
    targets, shape = config.views - given, (8, 4, 4)
    model = MultiViewModel(config)
    model.unet = MixtureNetwork(config, targets, shape)  # type: ignore[assignment]
    noise = torch.randn(groups, targets, *shape, generator=generator(0, "noise"))
    return model, torch.zeros(groups, given, *shape), torch.zeros(groups, config.views, 4, 4), noise


@torch.no_grad()
def model_problem(path: Path, groups: int = 2, given: int = 3) -> Problem:
    """A model file and groups of held-out procedural scenes."""
    from cat3d_core.random import normal
    from cat3d_core.rays import reference_from_image
    from cat3d_core.synthetic import FAMILIES
    from cat3d_core.synthetic.held_out import held_out_group

    model = load_model(path)
    parts = []
    for number in range(groups):
        traced, cameras = held_out_group(FAMILIES[number % len(FAMILIES)], number, model.config.image_size)
        latents = model.autoencoder.encode(traced.image)
        seen = reference_from_image(cameras, cameras.world_from_camera[0])
        noise = torch.stack([normal(latents.shape[1:], 0, number, v, "noise") for v in range(given, len(latents))])
        parts.append((latents[:given], seen, noise))
    latents, seen, noise = (torch.stack(part) for part in zip(*parts, strict=True))
    return model, latents, seen, noise


def rows(
    model_path: Path | None = None, steps: tuple[int, ...] = (10, 15, 20, 30, 50), groups: int | None = None
) -> list[dict[str, Any]]:
    """One row per problem, solver, nodes, steps, guidance interval and dtype: `evaluations` a group, `seconds` a group,
    `error` (median over groups of the RMS difference from the reference with the same interval), `error_p90`,
    `error_guided_p90` (of the difference from the reference that is guided everywhere), and `interval_change` (how far
    the reference itself moves when guidance is limited to the interval), and shares of the machine's limits (`limits`;
    of the network's evaluations alone). model_path: measure this model instead."""
    name, problem = ("mixture", mixture_problem(groups or 64))
    if model_path is not None:
        name, problem = "model", model_problem(model_path, groups or 2)
    model, latents, cameras, noise = problem
    references = {}
    model.unet.double()
    for interval, (low, high) in INTERVALS.items():
        solver, nodes, count = REFERENCE
        config = SamplerConfig(solver, nodes, count, GuidanceConfig(3.0, low, high))  # type: ignore[arg-type]
        references[interval] = sample(model, latents.double(), cameras, noise.double(), config)
    result = []
    for dtype_name, dtype in DTYPES.items():
        model.unet.to(dtype)
        one = evaluation_work(problem, dtype)
        format_ = torch.float64 if name == "mixture" else dtype  # the closed form is computed in float64
        for interval, (low, high) in INTERVALS.items():
            guidance = GuidanceConfig(3.0, low, high)
            for solver in SOLVERS:
                for nodes in get_args(Nodes):
                    for count in steps:
                        config = SamplerConfig(solver, nodes, count, guidance)
                        row = {"problem": name, "solver": solver, "nodes": nodes, "steps": count, "interval": interval}
                        change = (references[interval] - references["all"]).square().mean().sqrt()
                        measured = _measure(problem, config, references[interval], references["all"])
                        measured |= limits.columns(one * measured["evaluations"], measured["seconds"], dtype=format_)
                        result.append(row | {"dtype": dtype_name, "interval_change": float(change)} | measured)
    return result


def evaluation_work(problem: Problem, dtype: torch.dtype) -> limits.Work:
    """One group's share of a step with one evaluation of the network, which is in `dtype`: the operations; the weights,
    read once for all groups, and latents in and out."""
    model, latents, cameras, noise = problem
    config, groups = SamplerConfig("ddim", steps=1, guidance=GuidanceConfig(1.0)), len(noise)
    flops = counted(lambda: sample(model, latents, cameras, noise, config))
    moved = network_bytes(model.unet) + 2 * (latents.numel() + noise.numel()) * dtype.itemsize
    return limits.Work(flops / groups, moved / groups)


def _measure(problem: Problem, config: SamplerConfig, reference: Tensor, guided: Tensor) -> dict[str, float]:
    model, latents, cameras, noise = problem
    start = time.perf_counter()
    out = sample(model, latents, cameras, noise, config)
    seconds = time.perf_counter() - start
    error = (out.double() - reference).square().mean((1, 2, 3, 4)).sqrt()
    return {
        "evaluations": evaluations(config, Schedule(model.config.schedule, noise.shape[1])),
        "seconds": seconds / len(noise),
        "error": float(error.median()),
        "error_guided_p90": float((out.double() - guided).square().mean((1, 2, 3, 4)).sqrt().quantile(0.9)),
        "error_p90": float(error.quantile(0.9)),
    }


def front(result: list[dict[str, Any]], cost: str = "evaluations") -> list[dict[str, Any]]:
    """The rows that no other row beats in both cost and error, cheapest first."""
    best, chosen = math.inf, []
    for row in sorted(result, key=lambda r: (r[cost], r["error"])):
        if row["error"] < best:
            chosen.append(row)
            best = row["error"]
    return chosen


def table(result: list[dict[str, Any]]) -> str:
    """Markdown: a line per solver, nodes and interval, a column per number of steps; float32 (bfloat16) errors."""
    counts = sorted({r["steps"] for r in result})
    error = {(r["solver"], r["nodes"], r["interval"], r["dtype"], r["steps"]): r["error"] for r in result}
    lines = ["| solver | nodes | guidance | " + " | ".join(map(str, counts)) + " |", "|---" * (3 + len(counts)) + "|"]
    for key in dict.fromkeys((r["solver"], r["nodes"], r["interval"]) for r in result):
        cells = [f"{error[*key, 'float32', n]:.4f} ({error[*key, 'bfloat16', n]:.4f})" for n in counts]
        lines.append(f"| {' | '.join(key)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def plot(result: list[dict[str, Any]], path: Path) -> None:
    """Error against evaluations (float32), one line per solver and nodes, a panel per guidance interval."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    axes = figure.subplots(1, len(INTERVALS), sharey=True)
    markers = dict(zip(get_args(Nodes), "osv^", strict=True))
    for axis, interval in zip(axes, INTERVALS, strict=True):
        for color, solver in enumerate(SOLVERS):
            for nodes, marker in markers.items():
                line = [
                    r
                    for r in result
                    if (r["solver"], r["nodes"], r["interval"], r["dtype"]) == (solver, nodes, interval, "float32")
                ]
                axis.plot(
                    [r["evaluations"] for r in line],
                    [r["error"] for r in line],
                    color=f"C{color}",
                    marker=marker,
                    label=f"{solver}, {nodes}",
                )
        axis.set(title=f"guidance: {interval}", xlabel="evaluations a group", yscale="log", xscale="log")
    axes[0].set_ylabel("RMS error of latents")
    axes[-1].legend(fontsize="x-small")
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, help="a model file to measure instead of the mixture")
    parser.add_argument("--steps", type=int, nargs="+", default=[10, 15, 20, 30, 50])
    parser.add_argument("--groups", type=int)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    result = rows(arguments.model, tuple(arguments.steps), arguments.groups)
    print(table(result))
    for dtype in DTYPES:
        for interval in INTERVALS:
            print(f"\nFront, {dtype}, guidance {interval}:")
            for row in front([r for r in result if r["dtype"] == dtype and r["interval"] == interval]):
                print(
                    "  {solver} {nodes} {steps}: {evaluations} evaluations, error {error:.4f} (p90 "
                    "{error_p90:.4f})".format(**row)
                )
    if arguments.plot:
        plot(result, arguments.plot)


if __name__ == "__main__":
    main()
