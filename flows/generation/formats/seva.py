"""SEVA's weights, brought by the user, with the two models that they need beside them."""

from __future__ import annotations

import functools
from pathlib import Path

import torch

from cat3d_core.generation import Generator, GeneratorSpec
from cat3d_core.seva.checkpoint import FILE_NAMES, find_seva, read_config
from cat3d_core.seva.generator import SevaGenerator, seva_spec
from cat3d_core.seva.model import load_seva_model
from schemas.content_key import content_key, file_sha256

LOOKS_FOR = (
    f"SEVA's {' or '.join(FILE_NAMES)}, or the folder with it, in which also are vae/ (Stable Diffusion 2.1's "
    "autoencoder, as diffusers has it) and image_encoder/ (OpenCLIP's ViT-H/14)"
)


def recognises(path: Path) -> bool:
    """Whether it is, or holds, weights of SEVA."""
    return find_seva(path) is not None


def describe(path: Path | None) -> GeneratorSpec:
    """What the network is; its identity is that of all three models' files. Raises ValueError where one is missing."""
    weights, autoencoder, tower = _parts(path)
    encoder = content_key(files=[_digest(file) for file in sorted(autoencoder.iterdir()) if file.is_file()])
    identity = content_key(weights=_digest(weights), encoder=encoder, tower=_digest(tower))
    beside = sum(file.stat().st_size for file in (*autoencoder.glob("*.safetensors"), tower))
    return seva_spec(read_config(weights), identity, encoder, beside)


def _digest(file: Path) -> str:
    status = file.stat()
    return _hashed(file, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=16)
def _hashed(file: Path, _changed: int, _size: int) -> str:
    """Once in a process: together the files have ten gigabytes."""
    return file_sha256(file)


def load(path: Path | None, device: str, precision: str) -> Generator:
    """The three models on `device`; `precision` is the network's, the others stay in float32. Raises ValueError."""
    model = load_seva_model(*_parts(path), device, getattr(torch, precision))
    return SevaGenerator(model, describe(path))


def _parts(path: Path | None) -> tuple[Path, Path, Path]:
    """The weights, the autoencoder's folder and the file of the image tower. Raises ValueError naming what isn't
    there."""
    weights = None if path is None else find_seva(path)
    if weights is None:
        raise ValueError(f"{path or 'sample.checkpoint'} holds no weights of SEVA; looked for {LOOKS_FOR}.")
    autoencoder, encoder = weights.parent / "vae", weights.parent / "image_encoder"
    if not (autoencoder / "config.json").is_file():
        raise ValueError(
            f"{autoencoder} is missing: SEVA's latents are those of Stable Diffusion 2.1's autoencoder. Put its folder "
            "(config.json and diffusion_pytorch_model.safetensors), or a link to it, there."
        )
    files = sorted(encoder.glob("*.safetensors")) or sorted([*encoder.glob("*.bin"), *encoder.glob("*.pt")])
    if len(files) != 1:
        raise ValueError(
            f"{encoder} should hold one file of weights of OpenCLIP's ViT-H/14 (laion2b_s32b_b79k), but has "
            f"{len(files)}: put its open_clip_model.safetensors, or a link to it, there."
        )
    return weights, autoencoder, files[0]
