"""SEVA's weights, in a file that the user has: recognised by its header, read with every weight accounted for."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from cat3d_core.diffusion.ldm_names import to_ldm
from cat3d_core.seva.config import SevaConfig
from cat3d_core.seva.network import SevaUNet

#: What is said whenever such weights are opened.
LICENCE = (
    "These are weights of SEVA (Stable Virtual Camera): the Stability AI Non-Commercial License holds for them and for "
    "the views and scenes made with them, which must not be used commercially, nor to train or improve any other "
    "foundational generative model."
)
#: Why nothing is trained from them here.
NO_START = (
    "{path} holds weights of SEVA, whose licence (Stability AI Non-Commercial License) doesn't let them or their "
    "outputs be used to make another generative model: start from a Stable Diffusion 1.x or 2.x U-Net instead."
)
#: Names of the file in a folder: version 1.1, version 1.0.
FILE_NAMES = ("modelv1.1.safetensors", "model.safetensors")
_FIRST = "input_blocks.0.0.weight"
_MARKS = ("time_mix_blocks", "dense_emb_layers")
_LEVELS = tuple(f"input_blocks.{block}.0.in_layers.2.weight" for block in (1, 4, 7, 10))
_CONTEXT = "middle_block.1.transformer_blocks.0.attn2.to_k.weight"
_DESCRIPTION = "cat3d_seva"  # of the metadata of files written here: JSON
_DTYPES = (torch.float32, torch.float16, torch.bfloat16)


def is_seva(shapes: dict[str, tuple[int, ...]]) -> bool:
    """Whether weights of these names and shapes are SEVA's, of any width (a Stable Diffusion U-Net in a file of the
    same layout has no rays at its input and no time mixing)."""
    first = shapes.get(_FIRST, ())
    return tuple(first[1:]) == (11, 3, 3) and all(any(mark in name for name in shapes) for mark in _MARKS)


def find_seva(path: str | Path) -> Path | None:
    """The file of SEVA's weights that `path` is or, as a folder, holds under one of its names; None where there is no
    such file. Raises ValueError where a folder holds both versions."""
    path = Path(path)
    candidates = [path / name for name in FILE_NAMES] if path.is_dir() else [path]
    found = [file for file in candidates if file.is_file() and is_seva(_shapes(file))]
    if len(found) > 1:
        raise ValueError(f"{path} holds two versions of SEVA: name {found[0].name} (1.1) or {found[1].name} (1.0).")
    return found[0] if found else None


def read_config(path: str | Path) -> SevaConfig:
    """The network's shape from a file's header; what shapes don't tell (the channels of a head, the views of a window)
    is SEVA's own unless the file's metadata says otherwise, as that of `save_seva` does. Raises ValueError for a file
    that isn't SEVA's or lacks a weight."""
    shapes = _shapes(Path(path))
    if not is_seva(shapes):
        raise ValueError(f"{path} holds no weights of SEVA (a network of 11 input channels with time_mix_blocks).")
    for name in (*_LEVELS, _CONTEXT):
        if name not in shapes:
            raise ValueError(f"{path} is not all of SEVA: {name} is missing. Fetch the file again.")
    description = json.loads(_metadata(Path(path)).get(_DESCRIPTION, "{}"))
    first, second, third, fourth = (shapes[name][0] for name in _LEVELS)
    try:
        return SevaConfig((first, second, third, fourth), context_channels=shapes[_CONTEXT][1], **description)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} describes no network of SEVA's kind: {error}") from None


def load_seva(path: str | Path, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> SevaUNet:
    """The network of a file, in eval mode, in `dtype` or else that of the file.

    Every weight of the network has to be in the file with its shape, and nothing else. Raises ValueError, naming the
    first odd weight, for a file that is another's, incomplete, damaged or of another type of numbers.
    """
    path = Path(path)
    config = read_config(path)
    with torch.device("meta"):
        network = SevaUNet(config)
    own = {name: tuple(weight.shape) for name, weight in network.state_dict().items()}
    theirs = to_ldm(own)
    expected, shapes = {theirs[name]: shape for name, shape in own.items()}, _shapes(path)
    if odd := sorted(name for name in expected.keys() | shapes if expected.get(name) != shapes.get(name)):
        fault = "is missing" if odd[0] not in shapes else "has another shape" if odd[0] in expected else "is unknown"
        raise ValueError(
            f"{path} is not SEVA 1.0 or 1.1 as it should be: {odd[0]} {fault} ({len(odd)} such weights in all). "
            "Fetch the file again."
        )
    state: dict[str, Tensor] = {}
    with safe_open(path, "pt", device=str(device)) as file:
        for name in own:
            weight = file.get_tensor(theirs[name])
            if weight.dtype not in _DTYPES:
                raise ValueError(f"{path}: {theirs[name]} is {weight.dtype}; float32, float16 or bfloat16 is read.")
            if not torch.isfinite(weight).all():
                raise ValueError(
                    f"{path} is damaged: {theirs[name]} has a NaN or infinite number. Fetch the file again."
                )
            state[name] = weight if dtype is None else weight.to(dtype)
    network.load_state_dict(state, assign=True)
    return network.eval().requires_grad_(False)


def save_seva(path: str | Path, network: SevaUNet) -> None:
    """Write a network of any width in the layout of SEVA's files, with what a reader can't tell from shapes."""
    config = network.config
    description = {name: getattr(config, name) for name in ("head_channels", "views", "image_size")}
    state = network.state_dict()
    names = to_ldm(state)
    partial = Path(path).with_name(Path(path).name + ".partial")
    weights = {names[name]: t.detach().cpu().contiguous() for name, t in state.items()}
    save_file(weights, partial, {_DESCRIPTION: json.dumps(description)})
    partial.replace(path)


def random_seva(config: SevaConfig, seed: int = 0) -> SevaUNet:
    """A network of random weights, for tests and measurements: outputs are about as large as inputs."""
    generator = torch.Generator().manual_seed(seed)
    network = SevaUNet(config).eval().requires_grad_(False)
    for name, weight in network.named_parameters():
        if weight.dim() > 1:
            weight.copy_(torch.randn(weight.shape, generator=generator) * weight[0].numel() ** -0.5)
        else:
            center = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            weight.copy_(center + 0.1 * torch.randn(weight.shape, generator=generator))
    return network


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the file's tensors, read from its header; none for a file that isn't safetensors."""
    try:
        with safe_open(path, "pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError):
        return {}


def _metadata(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        return file.metadata() or {}
