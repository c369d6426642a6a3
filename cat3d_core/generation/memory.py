"""Working in the largest batches that memory holds: out of memory, the batch is halved and tried again."""

from __future__ import annotations

import gc
from collections.abc import Callable

import torch
from torch import Tensor


class MemoryTooSmall(MemoryError):
    """Not even one group fits; the message says what to do."""


class Memory:
    """Remembers how many groups fit at once on a device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.most: int | None = None

    def run(self, work: Callable[[int], Tensor], at_once: int, what: str) -> Tensor:
        """work(n) for the largest n <= at_once that fits. Raises MemoryTooSmall where one `what` doesn't."""
        count = at_once if self.most is None else min(at_once, self.most)
        while True:
            try:
                return work(count)
            except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
                if not out_of_memory(error):
                    raise
                if count == 1:
                    raise MemoryTooSmall(
                        f"Memory doesn't hold one {what} on {self.device} ({error}): "
                        "use a smaller model, sample.precision bfloat16, or a device with more memory."
                    ) from None
                count //= 2
                self.most = count
            # Outside the handler: inside, the traceback still holds the activations.
            gc.collect()
            if self.device.type == "cuda":
                torch.cuda.empty_cache()


def out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed; PyTorch's CPU allocator raises a plain RuntimeError."""
    text = str(error)
    return isinstance(error, (torch.OutOfMemoryError, MemoryError)) or "can't allocate memory" in text
