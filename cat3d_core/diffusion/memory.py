"""How much memory a network takes, found before it is loaded: its operations run on tensors without data."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from cat3d_core.diffusion.autoencoder import Autoencoder
from cat3d_core.diffusion.config import ModelConfig
from cat3d_core.diffusion.unet import MultiViewUNet


class Need(NamedTuple):
    """Bytes: of the weights, and at most of what is computed beside them at one time."""

    weights: int
    work: int

    @property
    def total(self) -> int:
        return self.weights + self.work


class _Living(TorchDispatchMode):
    """Counts the bytes of all storages that operations make, as long as they are in use."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        return out

    def _count(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key in self.known:
            return
        self.known.add(key)
        self.now += size
        self.peak = max(self.peak, self.now)
        weakref.finalize(storage, self._free, key, size)

    def _free(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.now -= size


class _FusedAttention(TorchFunctionMode):
    """Attention as its fused kernels do it: no tensor but the result."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is F.scaled_dot_product_attention:
            return torch.empty_like(args[0])
        return func(*args, **(kwargs or {}))


@torch.no_grad()
def peak_bytes(compute: Callable[[], object]) -> int:
    """The most bytes that tensors made while `compute()` runs take at one time, on whatever device they are: on "meta"
    nothing is allocated or computed. What kernels take for themselves is not in it."""
    with _FusedAttention(), _Living() as living:
        compute()
    return living.peak


def weight_bytes(modules: Iterable[nn.Module]) -> int:
    """Bytes of parameters and buffers."""
    tensors = (t for module in modules for t in (*module.parameters(), *module.buffers()))
    return sum(t.numel() * t.element_size() for t in tensors)


def multiview_need(config: ModelConfig, groups: int, dtype: torch.dtype = torch.float32) -> Need:
    """Of sampling so many groups at once with guidance (twice as many in the network), and of encoding and decoding one
    image; the autoencoder stays in float32."""
    size, channels = config.unet.latent_size, config.unet.latent_channels
    with torch.device("meta"):
        unet, autoencoder = MultiViewUNet(config.unet).to(dtype), Autoencoder(config.autoencoder)
        latents = torch.empty(2 * groups, config.views, channels, size, size, dtype=dtype)
        cameras, mask = torch.empty(*latents.shape[:2], 4, 4), torch.empty(latents.shape[:2])
        images = torch.empty(1, 3, config.image_size, config.image_size)
    work = max(
        peak_bytes(lambda: unet(latents, torch.empty(2 * groups, device="meta"), cameras, mask)),
        peak_bytes(lambda: autoencoder.decode(autoencoder.encode(images))),
    )
    return Need(weight_bytes([unet, autoencoder]), work)
