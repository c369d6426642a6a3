"""What a piece of work asks of the worker that does it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Needs(BaseModel):
    """gpu: whether it computes on an accelerator where there is one; without, any worker of a cluster may do it, and
    the Dask resource GPU is not asked for. memory_gb: main memory that it takes, in 10^9 bytes, at the least. The
    threads are the worker's own, `execution.threads`, as they decide how sums are split."""

    model_config = ConfigDict(frozen=True)

    gpu: bool = False
    memory_gb: float = 0.5

    def __str__(self) -> str:
        return f"{self.memory_gb:g} GB of memory" + (" and the resources of the settings" if self.gpu else "")
