"""Attention, and the one place where the views of a group become one sequence of tokens.

Everywhere else the G groups of V views are a plain batch of G*V images. Weights are those of a 2D network: joining
views adds no parameters (paper, section 3.1; MVDream), so a pretrained text-to-image U-Net loads as it is.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cat3d_core.diffusion.config import CameraInput, ViewAttention


def fold_views(tokens: Tensor, views: int, mode: ViewAttention) -> Tensor:
    """[G*V, L, C] tokens of single views -> the sequences that attend to each other.

    "3d": [G, V*L, C], space and views together; "temporal": [G*L, V, C], the views at one place; "none": unchanged.
    Groups never share a sequence.
    """
    if mode == "none":
        return tokens
    images, length, channels = tokens.shape
    if mode == "3d":
        return tokens.reshape(images // views, views * length, channels)
    folded = tokens.reshape(images // views, views, length, channels).transpose(1, 2)
    return folded.reshape(images // views * length, views, channels)


def unfold_views(tokens: Tensor, views: int, length: int, mode: ViewAttention) -> Tensor:
    """The inverse of `fold_views`: back to [G*V, length, C]."""
    if mode == "none":
        return tokens
    channels = tokens.shape[-1]
    if mode == "3d":
        return tokens.reshape(-1, length, channels)
    return tokens.reshape(-1, length, views, channels).transpose(1, 2).reshape(-1, length, channels)


class ViewFrames:
    """Where the tokens of a group stand, for attention that depends on relative cameras alone (PRoPE: Li et al. 2025,
    "Cameras as relative positional encoding").

    Half of a head's channels are points in the frame of their view's camera, four at a time: `to_common` and
    `from_common` carry them between the views' projective frames (`conditioning.view_matrices`). The other half turn
    with the token's place in the image (rotary encoding). Attention between views i and j then sees P_i P_j^-1 and
    differences of places: it does not change if the reference frame does.
    """

    def __init__(self, image_from_reference: Tensor, reference_from_image: Tensor) -> None:
        """The projections of all views [G*V, 4, 4] and their inverses."""
        self.image_from_reference, self.reference_from_image = image_from_reference, reference_from_image
        self.height = self.width = 1

    def at(self, height: int, width: int) -> ViewFrames:
        """The same for feature maps of this size."""
        frames = ViewFrames(self.image_from_reference, self.reference_from_image)
        frames.height, frames.width = height, width
        return frames

    def queries(self, tokens: Tensor) -> Tensor:
        """[G, V*L, heads, d] -> the same, so that products with `to_common` of keys are relative."""
        return self._carry(tokens, self.image_from_reference.mT, 1)

    def to_common(self, tokens: Tensor) -> Tensor:
        """Keys or values [G, V*L, heads, d] -> the same in the frame that all views share."""
        return self._carry(tokens, self.reference_from_image, 1)

    def from_common(self, tokens: Tensor) -> Tensor:
        """What attention gathered [G, V*L, heads, d] -> in the frame of the view that asked."""
        return self._carry(tokens, self.image_from_reference, -1)

    def _carry(self, tokens: Tensor, matrices: Tensor, turn: int) -> Tensor:
        half = tokens.shape[-1] // 2
        points = tokens[..., :half].reshape(len(matrices), -1, 4) @ matrices.mT.to(tokens)
        cosine, sine = (part.to(tokens) for part in self._angles(half, tokens.device))
        first, second = tokens[..., half:].reshape(len(matrices), self.height * self.width, -1, half).chunk(2, -1)
        turned = torch.cat([first * cosine - turn * second * sine, second * cosine + turn * first * sine], -1)
        return torch.cat([points.reshape_as(tokens[..., :half]), turned.reshape_as(tokens[..., :half])], -1)

    def _angles(self, half: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Cosine and sine [L, 1, half / 2] of each token's place (u, v in [-1, 1]) at frequencies pi / 4 to 2 pi."""
        frequencies = math.pi * 2 ** torch.linspace(-2, 1, half // 4, device=device)
        v, u = torch.meshgrid(
            *((torch.arange(n, device=device) + 0.5) * (2 / n) - 1 for n in (self.height, self.width)), indexing="ij"
        )
        angles = torch.cat([u.reshape(-1, 1) * frequencies, v.reshape(-1, 1) * frequencies], -1)[:, None]
        return angles.cos(), angles.sin()


class Attention(nn.Module):
    """Multi-head attention (key names as in diffusers). PyTorch picks the kernel."""

    def __init__(self, channels: int, heads: int, context_channels: int | None = None) -> None:
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k = nn.Linear(context_channels or channels, channels, bias=False)
        self.to_v = nn.Linear(context_channels or channels, channels, bias=False)
        self.to_out = nn.ModuleList([nn.Linear(channels, channels)])

    def forward(self, tokens: Tensor, context: Tensor | None = None, frames: ViewFrames | None = None) -> Tensor:
        """tokens [B, L, C], context [B, K, C'] (None: self-attention) -> [B, L, C]. With `frames` (self-attention
        over V views of a group) it depends on relative cameras."""
        if context is not None and context.shape[1] == 1:  # the softmax over one key is 1, whatever the query
            constant: Tensor = self.to_out[0](self.to_v(context))
            return constant.expand(-1, tokens.shape[1], -1)
        context = tokens if context is None else context
        q, k, v = (
            t.unflatten(-1, (self.heads, -1)) for t in (self.to_q(tokens), self.to_k(context), self.to_v(context))
        )
        if frames is not None:
            q, k, v = frames.queries(q), frames.to_common(k), frames.to_common(v)
        gathered = F.scaled_dot_product_attention(*(t.transpose(1, 2) for t in (q, k, v))).transpose(1, 2)
        if frames is not None:
            gathered = frames.from_common(gathered)
        out: Tensor = self.to_out[0](gathered.flatten(-2))
        return out


class GEGLU(nn.Module):
    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.proj = nn.Linear(channels, 2 * hidden)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.proj(x).chunk(2, -1)
        return value * F.gelu(gate)


class FeedForward(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        # Index 1 is diffusers' dropout: kept so that the keys net.0 and net.2 agree.
        self.net = nn.ModuleList([GEGLU(channels, 4 * channels), nn.Identity(), nn.Linear(4 * channels, channels)])

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.net[2](self.net[0](x))
        return out


class TransformerBlock(nn.Module):
    """Self-attention over space (and views), then a feed-forward layer.

    The text cross-attention of the 2D network is gone: on one constant token it adds the same vector to every token, so
    it folds into the bias of attn1's output (see pretrained.py). It exists only for the camera-vector ablation.
    """

    def __init__(self, channels: int, heads: int, mode: ViewAttention, context_channels: int | None) -> None:
        super().__init__()
        self.mode = mode
        self.norm1 = nn.LayerNorm(channels)
        self.attn1 = Attention(channels, heads)
        if mode == "temporal":
            self.norm_views = nn.LayerNorm(channels)
            self.attn_views = Attention(channels, heads)
        if context_channels is not None:
            self.norm2 = nn.LayerNorm(channels)
            self.attn2 = Attention(channels, heads, context_channels)
        self.norm3 = nn.LayerNorm(channels)
        self.ff = FeedForward(channels)

    def forward(self, tokens: Tensor, views: int, context: Tensor | None, frames: ViewFrames | None = None) -> Tensor:
        """tokens [G*V, L, C], context [G*V, 1, C'] -> [G*V, L, C]. `frames` are for 3D attention."""
        mode: ViewAttention = "none" if self.mode == "temporal" else self.mode
        tokens = tokens + self._attend(self.attn1, self.norm1(tokens), views, mode, frames if mode == "3d" else None)
        if self.mode == "temporal":
            tokens = tokens + self._attend(self.attn_views, self.norm_views(tokens), views, "temporal")
        if context is not None:
            tokens = tokens + self.attn2(self.norm2(tokens), context)
        return tokens + self.ff(self.norm3(tokens))

    @staticmethod
    def _attend(
        attention: nn.Module, tokens: Tensor, views: int, mode: ViewAttention, frames: ViewFrames | None = None
    ) -> Tensor:
        joined = attention(fold_views(tokens, views, mode), None, frames)
        return unfold_views(joined, views, tokens.shape[1], mode)


class SpatialTransformer(nn.Module):
    """A transformer block on feature maps, with a residual around it. `linear_projection`: SD2 (else 1x1 convolutions,
    SD1)."""

    def __init__(
        self,
        channels: int,
        heads: int,
        mode: ViewAttention,
        camera: CameraInput,
        context_channels: int,
        linear_projection: bool,
        norm_groups: int,
    ) -> None:
        super().__init__()
        self.linear_projection = linear_projection
        self.norm = nn.GroupNorm(norm_groups, channels, eps=1e-6)
        self.proj_in = nn.Linear(channels, channels) if linear_projection else nn.Conv2d(channels, channels, 1)
        context = context_channels if camera == "vector" else None
        self.transformer_blocks = nn.ModuleList([TransformerBlock(channels, heads, mode, context)])
        self.proj_out = nn.Linear(channels, channels) if linear_projection else nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor, views: int, context: Tensor | None, frames: ViewFrames | None = None) -> Tensor:
        """x [G*V, C, h, w] -> the same shape."""
        height, width = x.shape[-2:]
        frames = None if frames is None else frames.at(height, width)
        h = self.norm(x)
        tokens = self.proj_in(_to_tokens(h)) if self.linear_projection else _to_tokens(self.proj_in(h))
        tokens = self.mix(tokens, views, context, frames)
        if self.linear_projection:
            return x + _to_map(self.proj_out(tokens), height, width)
        out: Tensor = x + self.proj_out(_to_map(tokens, height, width))
        return out

    def mix(self, tokens: Tensor, views: int, context: Tensor | None, frames: ViewFrames | None) -> Tensor:
        """The blocks on tokens [G*V, h*w, C] -> the same shape."""
        for block in self.transformer_blocks:
            tokens = block(tokens, views, context, frames)
        return tokens


def _to_tokens(x: Tensor) -> Tensor:
    return x.flatten(2).transpose(1, 2)


def _to_map(tokens: Tensor, height: int, width: int) -> Tensor:
    return tokens.transpose(1, 2).reshape(tokens.shape[0], tokens.shape[2], height, width)


def zero_(module: nn.Module) -> None:
    """Set all parameters of a module to zero."""
    for parameter in module.parameters():
        torch.nn.init.zeros_(parameter)
