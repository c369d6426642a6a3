"""The metric packages of the peers' environment beside ours, in one process there: `cat3d bench metrics`."""

from __future__ import annotations

from flows.bench.peers.task import Row, Task, answer

# isort: split
import torch

from flows.bench.metrics import rows
from flows.bench.peers.torchvision_cpu import allow_torchvision


def measure(task: Task) -> list[Row]:
    """settings: views, height, width, repeats, threads."""
    allow_torchvision()
    torch.set_num_threads(task.settings["threads"])
    sizes = {name: task.settings[name] for name in ("views", "height", "width", "repeats")}
    shares = ("gflop_per_s", "gb_per_s", "share_of_limit", "bound_by")
    return [
        {"who": row["implementation"], "setting": row["metric"], "seconds": row["seconds_per_view"],
         "error": row.get("error"), "times_ours": row.get("times_ours"),
         **{name: row[name] for name in shares if name in row}}
        for row in rows(**sizes)
    ]  # fmt: skip


if __name__ == "__main__":
    answer(measure)
