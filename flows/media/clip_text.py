"""CLIP embedding of a text, from a Hugging Face folder of a CLIP model that the user has (needs the extra `text`)."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor

from cat3d_core.metrics.clip import VARIABLE
from flows.errors import InputError

_NEEDED = ("config.json", "tokenizer_config.json")


def text_embedding(text: str) -> Tensor | None:
    """Unit embedding (D,) of a text by the model whose image tower CAT3D_CLIP_WEIGHTS names; None where that is unset,
    has no text tower and tokenizer beside it, or transformers is not installed. Raises InputError for a damaged one."""
    given = os.environ.get(VARIABLE)
    if not given:
        return None
    folder = Path(given) if Path(given).is_dir() else Path(given).parent
    if not all((folder / name).is_file() for name in _NEEDED):
        return None
    try:
        from transformers import AutoTokenizer, CLIPTextModelWithProjection
    except ImportError:
        return None
    try:
        tokenizer = AutoTokenizer.from_pretrained(str(folder), local_files_only=True)  # nosec B615 # a folder here
        tower = CLIPTextModelWithProjection.from_pretrained(  # nosec B615 # a folder here
            str(folder), local_files_only=True, use_safetensors=True
        )
    except (OSError, ValueError) as error:
        raise InputError(f"{VARIABLE}: no text tower of CLIP in {folder}: {' '.join(str(error).split())}") from None
    tokens = tokenizer(text, return_tensors="pt", truncation=True)
    with torch.no_grad():
        (embedding,) = tower.eval()(**tokens).text_embeds.float()
    return torch.nn.functional.normalize(embedding, dim=-1)
