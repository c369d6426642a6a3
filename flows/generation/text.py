"""Text -> photo: a text-to-image pipeline from a folder that the user has makes the one photo of a scene.

The photo lies with its settings in OUT/prompts/NAME, and is read from there as any single photo is; the same text with
the same settings is made once.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from cat3d_core.random import derive_seed
from flows.errors import InputError
from flows.jobs.device import device, free_device_memory
from flows.jobs.scene import file_sha256
from flows.media.images import write_png
from flows.progress import console
from flows.readers.photos import PROMPT_SETTINGS as SETTINGS
from schemas.documents import write_bytes
from schemas.errors import ConfigError


@dataclass(frozen=True)
class Prompt:
    """What is asked for. pipeline: a folder as diffusers writes it; None: the pipeline's own default."""

    text: str
    pipeline: Path
    seed: int = 0
    steps: int | None = None
    guidance: float | None = None
    side: int | None = None


def make_prompt(text: str, pipeline: Path, seed: int, settings: str) -> Prompt:
    """What the command line asks for; settings: YAML such as {steps: 20, side: 512}. Raises ConfigError."""
    try:
        document = yaml.safe_load(settings) or {}
    except yaml.YAMLError as error:
        raise ConfigError(f"--text-settings is not valid YAML: {' '.join(str(error).split())}.") from None
    for name, value in document.items() if isinstance(document, dict) else [(settings, None)]:
        fits = isinstance(value, (int, float) if name == "guidance" else int) and not isinstance(value, bool)
        if name not in ("steps", "guidance", "side") or not fits or float(value or 0) <= 0:
            raise ConfigError(f"--text-settings: {name} must be one of steps, guidance, side, with a positive number.")
    return Prompt(text, pipeline, seed, **document)


def text_to_photo(prompt: Prompt, out: Path) -> Path:
    """The folder with the photo and its settings, made where it isn't there yet.

    Raises InputError for an empty text, a folder that holds no such pipeline, or where the extra `text` is missing.
    """
    if not prompt.text.strip():
        raise InputError("--prompt is empty: say in words what the photo shows.")
    wanted = settings(prompt)
    folder = out / "prompts" / _name(prompt.text, wanted)
    if (folder / SETTINGS).is_file() and (folder / "photo.png").is_file():
        known = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
        if known["settings"] == wanted and known["photo_sha256"] == file_sha256(folder / "photo.png"):
            console.print(f"The photo of “{prompt.text}” is there already: {folder / 'photo.png'}")
            return folder
    made = _made(prompt)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / SETTINGS).unlink(missing_ok=True)
    write_png(folder / "photo.png", made)
    document = {"settings": wanted, "photo_sha256": file_sha256(folder / "photo.png")}
    write_bytes(folder / SETTINGS, json.dumps(document, indent=1).encode())
    console.print(f"The photo of “{prompt.text}”: {folder / 'photo.png'}")
    return folder


def settings(prompt: Prompt) -> dict[str, Any]:
    """All that decides the photo, as JSON values: what was asked for, the pipeline's files, the libraries' versions."""
    index = prompt.pipeline / "model_index.json"
    if not index.is_file():
        raise InputError(
            f"--text-to-image {prompt.pipeline} is no folder of a text-to-image pipeline: it has no model_index.json. "
            "Give one as diffusers saves it; nothing is downloaded."
        )
    files = sorted(file for file in prompt.pipeline.rglob("*") if file.suffix in (".json", ".safetensors", ".txt"))
    parts = [f"{file.relative_to(prompt.pipeline)} {file_sha256(file)}" for file in files]
    asked = {name: value for name, value in asdict(prompt).items() if name != "pipeline" and value is not None}
    kind = json.loads(index.read_text(encoding="utf-8")).get("_class_name", "")
    return asked | {
        "pipeline": str(prompt.pipeline.resolve()),
        "pipeline_class": kind,
        "pipeline_sha256": hashlib.sha256("\n".join(parts).encode()).hexdigest(),
        "versions": {name: _version(name) for name in ("diffusers", "transformers", "torch")},
    }


def _made(prompt: Prompt) -> np.ndarray:
    """(H, W, 3) uint8."""
    pipeline, where = _loaded(prompt.pipeline), device()
    pipeline.to(where, torch.float16 if where == "cuda" else torch.float32)
    pipeline.set_progress_bar_config(disable=True)
    asked: dict[str, Any] = {"num_inference_steps": prompt.steps, "guidance_scale": prompt.guidance}
    asked |= {"height": prompt.side, "width": prompt.side}
    random = torch.Generator().manual_seed(derive_seed(prompt.seed, prompt.text, "text to photo"))
    with console.status(f"Making a photo of “{prompt.text}”"), torch.no_grad():
        result = pipeline(
            prompt=prompt.text, generator=random, **{name: value for name, value in asked.items() if value is not None}
        )
    image = np.asarray(result.images[0].convert("RGB"))
    del pipeline, result
    free_device_memory()
    if image.std() == 0:
        raise InputError(
            f"The pipeline of {prompt.pipeline} gave a picture of one colour, as its safety checker does, for "
            f"“{prompt.text}”: ask for something else, or with another seed."
        )
    return image


def _loaded(folder: Path) -> Any:
    """The pipeline in a folder, on the CPU: safetensors alone, nothing downloaded, no code of the folder's own."""
    try:
        import transformers
        from diffusers import DiffusionPipeline
        from diffusers.utils import logging
    except ImportError as error:
        raise InputError(
            f"Text needs two more packages ({error}): install them with `pip install cat3d[text]`."
        ) from None
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    transformers.utils.logging.disable_progress_bar()
    try:
        return DiffusionPipeline.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, low_cpu_mem_usage=False
        )
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"--text-to-image {folder} can't be loaded: {' '.join(str(error).split())}") from None


def _name(text: str, wanted: dict[str, Any]) -> str:
    """A folder's name: the text's first words, and a hash of all settings."""
    words = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")[:40].strip("_")
    digest = hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()
    return f"{words or 'text'}_{digest[:8]}"


def _version(name: str) -> str | None:
    try:
        return version(name)
    except ImportError:
        return None
