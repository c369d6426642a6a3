"""Names of a U-Net's weights in the files of Stable Diffusion's first code ("ldm") <-> ours, which are diffusers'."""

from __future__ import annotations

import re
from collections.abc import Iterable

_ENDS = {
    "time_embed.0": "time_embedding.linear_1",
    "time_embed.2": "time_embedding.linear_2",
    "input_blocks.0.0": "conv_in",
    "out.0": "conv_norm_out",
    "out.2": "conv_out",
}
_RESNET = {
    "in_layers.0": "norm1",
    "in_layers.2": "conv1",
    "emb_layers.1": "time_emb_proj",
    "dense_emb_layers.0": "map_proj",  # of SEVA alone
    "out_layers.0": "norm2",
    "out_layers.3": "conv2",
    "skip_connection": "conv_shortcut",
}
_TO_RESNET = {ours: theirs for theirs, ours in _RESNET.items()}


def from_ldm(names: Iterable[str]) -> dict[str, str]:
    """Ours for each of the names of one file. Raises ValueError for a name that is no part of such a U-Net."""
    names = list(names)
    # A level of the down path ends with a downsampler: its position tells how many blocks a level has.
    downsamplers = [int(match[1]) for name in names if (match := re.match(r"input_blocks\.(\d+)\.0\.op\.", name))]
    if not downsamplers:
        raise ValueError("no input block is a downsampler (input_blocks.*.0.op.weight)")
    return {name: _from_ldm(name, min(downsamplers)) for name in names}


def _from_ldm(name: str, per_level: int) -> str:
    for theirs, ours in _ENDS.items():
        if name.startswith(theirs + "."):
            return ours + name[len(theirs) :]
    if match := re.match(r"(input|output)_blocks\.(\d+)\.(\d+)\.(.+)", name):
        index, rest = int(match[2]) - (match[1] == "input"), match[4]
        level, block = divmod(index, per_level)
        side = "down_blocks" if match[1] == "input" else "up_blocks"
        if rest.startswith("op."):
            return f"{side}.{level}.downsamplers.0.conv.{rest[3:]}"
        if re.match(r"conv\.(weight|bias)$", rest):
            return f"{side}.{level}.upsamplers.0.{rest}"
        where = f"{side}.{level}.{{}}.{block}"
    elif match := re.match(r"middle_block\.(\d)\.(.+)", name):
        rest = match[2]
        where = f"mid_block.{{}}.{0 if match[1] == '1' else int(match[1]) // 2}"
    else:
        raise ValueError(f"weight {name} is no part of a Stable Diffusion U-Net")
    for theirs, ours in _RESNET.items():
        if rest.startswith(theirs + "."):
            return f"{where.format('resnets')}.{ours}{rest[len(theirs) :]}"
    return f"{where.format('attentions')}.{rest}"


def to_ldm(names: Iterable[str]) -> dict[str, str]:
    """The name in such a file for each of our names of one U-Net: the inverse of `from_ldm`."""
    names = list(names)
    per_level = 1 + len({name.split(".")[3] for name in names if name.startswith("down_blocks.0.resnets.")})
    with_attention = {name.split(".attentions.")[0] for name in names if ".attentions." in name}
    return {name: _to_ldm(name, per_level, with_attention) for name in names}


def _to_ldm(name: str, per_level: int, with_attention: set[str]) -> str:
    for theirs, ours in _ENDS.items():
        if name.startswith(ours + "."):
            return theirs + name[len(ours) :]
    match = re.match(r"(?:(down|up)_blocks\.(\d+)|mid_block)\.(\w+)\.(\d+)\.(.+)", name)
    if match is None:
        raise ValueError(f"weight {name} is no part of our U-Net")
    side, kind, block, rest = match[1], match[3], int(match[4]), match[5]
    level = int(match[2] or 0)
    if kind == "resnets":
        part, _, leaf = rest.rpartition(".")
        rest = f"{_TO_RESNET[part]}.{leaf}"
    if side is None:
        return f"middle_block.{1 if kind == 'attentions' else 2 * block}.{rest}"
    first = level * per_level
    if kind == "downsamplers":
        return f"input_blocks.{first + per_level}.0.op.{rest.removeprefix('conv.')}"
    if kind == "upsamplers":  # in the level's last block, behind its attention where it has one
        return f"output_blocks.{first + per_level - 1}.{2 if f'up_blocks.{level}' in with_attention else 1}.{rest}"
    where = f"input_blocks.{first + block + 1}" if side == "down" else f"output_blocks.{first + block}"
    return f"{where}.{0 if kind == 'resnets' else 1}.{rest}"
