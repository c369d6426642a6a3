"""nerfacto begun on a folder of photos with transforms.json, in the peers' environment: seconds and memory.

Through nerfstudio's own reader and its data manager in one process (its default one keeps a second copy of the photos
in a process of its own), the photos as they are: nerfstudio makes them smaller only where smaller copies lie there.
"""

from __future__ import annotations

from flows.bench.peers.task import STARTED, Row, Task, answer

# isort: split
import resource
import sys
import time
import types
from pathlib import Path

import torch

from flows.bench.peers.nerfacto import untrained
from flows.bench.peers.torchvision_cpu import allow_torchvision


def measure(task: Task) -> list[Row]:
    """settings: photos (the folder), rays (a step), steps, threads, gigabytes (refuse to hold more than so many).

    One row: load_seconds until the first step, step_seconds of one; `out_of_memory` where that was too little."""
    limit = int(task.settings["gigabytes"] * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    torch.set_num_threads(task.settings["threads"])
    allow_torchvision()
    sys.modules["newrawpy"] = types.ModuleType("newrawpy")  # reads raw photos, which these are not
    try:
        return [_begun(task)]
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            raise
        return [{"out_of_memory": True, "load_seconds": time.perf_counter() - STARTED}]


def _begun(task: Task) -> Row:
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    reader = NerfstudioDataParserConfig(data=Path(task.settings["photos"]))
    loader: VanillaDataManager = VanillaDataManagerConfig(
        dataparser=reader, train_num_rays_per_batch=task.settings["rays"]
    ).setup(device="cpu")
    count = len(loader.train_dataset)
    model = untrained(loader.train_dataset.scene_box, count)
    parameters = [p for group in model.get_param_groups().values() for p in group]
    optimiser = torch.optim.Adam(parameters, lr=1e-2, eps=1e-15)
    model.train()
    loaded = time.perf_counter()
    for step in range(task.settings["steps"]):
        bundle, batch = loader.next_train(step)
        outputs = model(bundle)
        loss = sum(model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch)).values())
        optimiser.zero_grad()
        loss.backward()  # type: ignore[union-attr]
        optimiser.step()
    seconds = (time.perf_counter() - loaded) / task.settings["steps"]
    return {"training_views": count, "load_seconds": loaded - STARTED, "step_seconds": seconds}


if __name__ == "__main__":
    answer(measure)
