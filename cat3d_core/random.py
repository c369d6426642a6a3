"""Counter-based randomness: the same key gives the same numbers on any worker, in any batch and order."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from torch import Tensor


def derive_seed(seed: int, *key: str | int) -> int:
    """A 63-bit seed from a run seed and a key such as (scene id, view id, purpose). SHA-256, so unrelated keys give
    unrelated streams."""
    text = "\x1f".join([str(int(seed)), *(f"{type(part).__name__}:{part}" for part in key)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def generator(seed: int, *key: str | int) -> torch.Generator:
    """A CPU generator for this key."""
    return torch.Generator().manual_seed(derive_seed(seed, *key))


def normal(shape: Sequence[int], seed: int, *key: str | int) -> Tensor:
    """Standard normal float32 numbers for this key, drawn on the CPU."""
    return torch.randn(tuple(shape), generator=generator(seed, *key))
