"""Files of weights: safetensors with metadata, written whole or not at all, and the hash that identifies them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor


def weights_hash(state: dict[str, Tensor]) -> str:
    """SHA-256 over names, dtypes, shapes and bytes, in the order of names: the same for equal weights in any file."""
    digest = hashlib.sha256()
    for name in sorted(state):
        tensor = state[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def exported(state: dict[str, Tensor], dtype: torch.dtype | None, path: Path) -> dict[str, Tensor]:
    """The state on the CPU, floating-point weights in `dtype`. Raises ValueError where one is not finite in it."""
    out = {
        name: (t.to(dtype) if dtype and t.is_floating_point() else t).detach().cpu().contiguous().clone()
        for name, t in state.items()
    }
    if not all(torch.isfinite(t).all() for t in out.values()):
        raise ValueError(
            f"The weights to be saved in {path} have values that are not finite (in {dtype or 'their dtype'})."
        )
    return out


def write_weights(path: Path, state: dict[str, Tensor], metadata: dict[str, str]) -> None:
    """The file appears under its name only when it is complete."""
    partial = path.with_name(path.name + ".partial")
    save_file(state, partial, metadata)
    partial.replace(path)


def read_weights(path: Path, weights: bool = True) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and, unless `weights` is False, tensors. Raises ValueError for a file that is not safetensors, and
    FileNotFoundError where there is none."""
    if not path.is_file():
        raise FileNotFoundError(f"There is no model file {path}.")
    try:
        with safe_open(path, "pt") as file:
            return file.metadata() or {}, {k: file.get_tensor(k) for k in file.keys()} if weights else {}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is not a readable safetensors file ({error}).") from error
