"""Several processes on one training, as torchrun starts them: who am I, what does rank 0's clock say."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist


@dataclass(frozen=True)
class Ranks:
    """This process among `world` equal ones. `device`: where it computes."""

    rank: int
    world: int
    device: torch.device

    @property
    def first(self) -> bool:
        return self.rank == 0

    def barrier(self) -> None:
        """Wait for all."""
        if self.world > 1:
            dist.barrier()

    def agreed(self, value: float) -> float:
        """Rank 0's value, on every rank: what depends on a clock has to be decided once."""
        if self.world == 1:
            return value
        shared = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.broadcast(shared, 0)
        return float(shared)


@contextlib.contextmanager
def ranks(device: str) -> Iterator[Ranks]:
    """Join the process group that torchrun's environment describes; alone without one. device: auto, cpu or cuda.

    Raises ValueError where CUDA is asked for and absent.
    """
    cuda = torch.cuda.is_available()
    if device == "cuda" and not cuda:
        raise ValueError("This machine has no CUDA device that torch can use; set device to cpu or auto.")
    kind = "cuda" if device in ("auto", "cuda") and cuda else "cpu"
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = torch.device(kind, int(os.environ.get("LOCAL_RANK", "0"))) if kind == "cuda" else torch.device("cpu")
    if kind == "cuda":
        torch.cuda.set_device(local)
    if world == 1:
        yield Ranks(0, 1, local)
        return
    # Rank 0 trains the autoencoder while the others wait: longer than the default timeout.
    dist.init_process_group("nccl" if kind == "cuda" else "gloo", timeout=timedelta(hours=24))
    try:
        yield Ranks(dist.get_rank(), dist.get_world_size(), local)
    finally:
        dist.destroy_process_group()
