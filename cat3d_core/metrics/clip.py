"""CLIP image score (Radford et al. 2021): cosine of two images' embeddings, from weights the user has.

The image tower of OpenAI's CLIP and of open_clip (keys `visual.*`) and of Hugging Face's models (`vision_model.*`), for
every plain vision transformer of that family. What a file of tensors doesn't say, the number of heads and the
activation, is read from the configuration beside it where there is one, else it is OpenAI's.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.metrics.images import image_pair
from cat3d_core.metrics.weights import read_tensors

VARIABLE = "CAT3D_CLIP_WEIGHTS"
# Of CLIP's training images, for inputs in [0, 1].
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_DEVIATION = (0.26862954, 0.26130258, 0.27577711)
_NAMES = {768: "vit-b", 1024: "vit-l", 1280: "vit-h", 1408: "vit-g", 1664: "vit-bigg"}


@dataclass(frozen=True)
class ClipConfig:
    """Shape of an image tower. size: side of the input in pixels; dimensions: of the embedding.

    quick_gelu: x sigmoid(1.702 x), as OpenAI's models have it, instead of the exact GELU (LAION's open_clip models).
    """

    width: int
    layers: int
    hidden: int
    patch: int
    size: int
    dimensions: int
    heads: int
    quick_gelu: bool = True

    @property
    def name(self) -> str:
        family = _NAMES.get(self.width, f"vit-{self.width}x{self.layers}")
        return f"clip-{family}/{self.patch}-{self.size}-{'quickgelu' if self.quick_gelu else 'gelu'}"


class _Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, config: ClipConfig) -> None:
        super().__init__()
        width = config.width
        self.heads, self.quick_gelu = config.heads, config.quick_gelu
        self.ln_1, self.ln_2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.fc, self.proj = nn.Linear(width, config.hidden), nn.Linear(config.hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in self.qkv(self.ln_1(x)).chunk(3, -1))
        x = x + self.out(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        hidden = self.fc(self.ln_2(x))
        hidden = hidden * torch.sigmoid(1.702 * hidden) if self.quick_gelu else F.gelu(hidden)
        return x + self.proj(hidden)


class ClipImageTower(nn.Module):
    """Images -> unit embeddings. Weights are frozen; they start random, `load_clip` fills them."""

    def __init__(self, config: ClipConfig, name: str = "") -> None:
        super().__init__()
        self.config, self.name = config, name or config.name
        self.conv1 = nn.Conv2d(3, config.width, config.patch, stride=config.patch, bias=False)
        self.class_embedding = nn.Parameter(torch.randn(config.width) / math.sqrt(config.width))
        tokens = (config.size // config.patch) ** 2 + 1
        self.positional_embedding = nn.Parameter(torch.randn(tokens, config.width) / math.sqrt(config.width))
        self.ln_pre, self.ln_post = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.blocks = nn.ModuleList([_Block(config) for _ in range(config.layers)])
        self.proj = nn.Parameter(torch.randn(config.width, config.dimensions) / math.sqrt(config.width))
        self.requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        """Embeddings of unit length (B, D) of images (B, 3, H, W) in [0, 1], of any size."""
        return F.normalize(self.embed(prepared(images.to(self.proj.dtype), self.config.size)), dim=-1)

    def embed(self, images: Tensor) -> Tensor:
        """Embeddings (B, D) as they come, of images (B, 3, size, size) normalised as CLIP's are."""
        x = self.conv1(images).flatten(2).mT
        first = self.class_embedding.expand(len(x), 1, -1)
        x = self.ln_pre(torch.cat([first, x], dim=1) + self.positional_embedding)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.ln_post(x[:, 0]) @ self.proj
        return out

    def score(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Cosine of the embeddings of each pair (B, 3, H, W): (B,), 1 for identical images."""
        prediction, target, _ = image_pair(prediction, target)
        return (self(prediction) * self(target)).sum(-1)


def prepared(images: Tensor, size: int) -> Tensor:
    """CLIP's input (B, 3, size, size): shorter side to `size` (bicubic, antialiased), its centre square, normalised."""
    height, width = images.shape[2:]
    if (height, width) != (size, size):
        scale = size / min(height, width)
        sides = [max(size, round(side * scale)) for side in (height, width)]
        images = F.interpolate(images, sides, mode="bicubic", antialias=True, align_corners=False).clamp(0.0, 1.0)
        top, left = ((side - size) // 2 for side in sides)
        images = images[:, :, top : top + size, left : left + size]
    return normalized(images)


def normalized(images: Tensor) -> Tensor:
    """Images (B, 3, H, W) in [0, 1] less the mean and over the deviation of CLIP's training images."""
    mean, deviation = (images.new_tensor(v).view(1, 3, 1, 1) for v in (_MEAN, _DEVIATION))
    return (images - mean) / deviation


# Our names of what stands in a file, after the tower's own prefix: OpenAI's and open_clip's, and Hugging Face's.
_OPENAI = (
    (r"transformer\.resblocks\.(\d+)\.attn\.in_proj_", r"blocks.\1.qkv."),
    (r"transformer\.resblocks\.(\d+)\.attn\.out_proj\.", r"blocks.\1.out."),
    (r"transformer\.resblocks\.(\d+)\.mlp\.c_", r"blocks.\1."),
    (r"transformer\.resblocks\.(\d+)\.", r"blocks.\1."),
)
_HUGGING_FACE = (
    (r"encoder\.layers\.(\d+)\.self_attn\.out_proj\.", r"blocks.\1.out."),
    (r"encoder\.layers\.(\d+)\.self_attn\.", r"blocks.\1."),
    (r"encoder\.layers\.(\d+)\.layer_norm(\d)\.", r"blocks.\1.ln_\2."),
    (r"encoder\.layers\.(\d+)\.mlp\.fc1\.", r"blocks.\1.fc."),
    (r"encoder\.layers\.(\d+)\.mlp\.fc2\.", r"blocks.\1.proj."),
    (r"embeddings\.class_embedding", "class_embedding"),
    (r"embeddings\.patch_embedding\.", "conv1."),
    (r"embeddings\.position_embedding\.weight", "positional_embedding"),
    (r"pre_layrnorm\.", "ln_pre."),
    (r"post_layernorm\.", "ln_post."),
)


def _renamed(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The image tower's tensors under our names; empty where the file has none."""
    prefix, rules = ("visual.", _OPENAI) if "visual.conv1.weight" in state else ("vision_model.", _HUGGING_FACE)
    out = {}
    for key, value in state.items():
        if not key.startswith(prefix):
            continue
        name = key.removeprefix(prefix)
        for pattern, ours in rules:
            name, found = re.subn(f"^{pattern}", ours, name)
            if found:
                break
        out[name] = value.float()
    if "visual_projection.weight" in state:
        out["proj"] = state["visual_projection.weight"].float().mT
    layers = {m.group(1) for m in map(re.compile(r"blocks\.(\d+)\.q_proj\.weight").fullmatch, out) if m}
    for layer in layers:
        for kind in ("weight", "bias"):
            parts = [out.pop(f"blocks.{layer}.{p}_proj.{kind}", torch.zeros(0)) for p in "qkv"]
            out[f"blocks.{layer}.qkv.{kind}"] = torch.cat(parts)
    out.pop("embeddings.position_ids", None)
    return out


def _config(state: Mapping[str, Tensor], folder: Path) -> ClipConfig:
    """The tower's shape from its tensors and, where one lies beside them, the model's configuration."""
    width, _, patch, _ = state["conv1.weight"].shape
    layers = 1 + max(int(key.split(".")[1]) for key in state if key.startswith("blocks."))
    side = math.isqrt(len(state["positional_embedding"]) - 1)
    hidden, dimensions = len(state["blocks.0.fc.bias"]), state["proj"].shape[1]
    config = ClipConfig(width, layers, hidden, patch, side * patch, dimensions, max(1, width // 64))
    if (folder / "config.json").is_file():  # Hugging Face
        document = _json(folder / "config.json")
        document = document.get("vision_config", document)
        heads = document.get("num_attention_heads", config.heads)
        return replace(config, heads=heads, quick_gelu=document.get("hidden_act", "quick_gelu") == "quick_gelu")
    if (folder / "open_clip_config.json").is_file():
        document = _json(folder / "open_clip_config.json").get("model_cfg", {})
        heads = width // document.get("vision_cfg", {}).get("head_width", 64)
        return replace(config, heads=heads, quick_gelu=document.get("quick_gelu", False))
    return config


def _json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} can't be read: {error}.") from None
    if not isinstance(document, dict):
        raise ValueError(f"{path} should hold the settings of a model.")
    return document


def load_clip(path: str | Path, quick_gelu: bool | None = None) -> ClipImageTower:
    """The image tower in a file of weights (.safetensors, or .pt of plain tensors); the text tower is left.

    quick_gelu: the activation where it is known beforehand; None: as the configuration beside the file says. Its name
    says its shape and, as models of one shape differ, the beginning of its weights' sha256. Raises ValueError naming
    the file for anything that is no CLIP vision transformer.
    """
    path = Path(path)
    state = _renamed(read_tensors(path))
    needed = ("conv1.weight", "positional_embedding", "blocks.0.fc.bias", "proj")
    if any(key not in state for key in needed):
        raise ValueError(f"{path}: holds no image tower of CLIP (visual.* or vision_model.* with its projection).")
    config = _config(state, path.parent)
    config = config if quick_gelu is None else replace(config, quick_gelu=quick_gelu)
    if config.width % config.heads:
        raise ValueError(f"{path}: {config.heads} heads don't divide the tower's width {config.width}.")
    digest = hashlib.sha256(b"".join(state[key].contiguous().numpy().tobytes() for key in ("conv1.weight", "proj")))
    with torch.device("meta"):  # a large tower is in memory once only
        tower = ClipImageTower(config, f"{config.name} {digest.hexdigest()[:8]}")
    own = tower.state_dict()
    for key in sorted(own.keys() | state.keys()):
        if key not in own or key not in state or own[key].shape != state[key].shape:
            raise ValueError(f"{path}: looks like {config.name}, but {key} is missing, unknown or does not fit.")
    tower.load_state_dict(state, assign=True)
    return tower.eval().requires_grad_(False)


def find_clip() -> ClipImageTower | None:
    """The tower in the file that CAT3D_CLIP_WEIGHTS names, or in the one file of tensors in that folder; None without
    the variable. Raises ValueError where it names something that can't be used."""
    given = os.environ.get(VARIABLE)
    if not given:
        return None
    path = Path(given)
    if path.is_dir():
        files = sorted(path.glob("*.safetensors"))
        if len(files) != 1:
            raise ValueError(f"{VARIABLE}: {path} holds {len(files)} .safetensors files; name the one to take.")
        path = files[0]
    try:
        file = path.stat()
        return _loaded(path, file.st_mtime_ns, file.st_size)
    except FileNotFoundError:
        raise ValueError(f"{VARIABLE}: {path}: there is no such file of weights.") from None
    except ValueError as error:
        raise ValueError(f"{VARIABLE}: {error}") from error


@lru_cache(maxsize=1)  # its name alone is asked for often, and these files are large
def _loaded(path: Path, changed_ns: int, size: int) -> ClipImageTower:
    return load_clip(path)
