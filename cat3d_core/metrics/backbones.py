"""The convolutional networks behind perceptual distances, cut after their last tap.

Each is a plain `nn.Sequential`, indexed as in torchvision, so that torchvision's files fit by their key names, with a
tuple of taps: the indices after which the activations are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Fire(nn.Module):
    """SqueezeNet's block: a 1x1 bottleneck, then 1x1 and 3x3 convolutions side by side."""

    def __init__(self, channels: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class BlurDownsample(nn.Module):
    """Every second pixel of a [1 2 1] x [1 2 1] / 16 blur, after reflection by two pixels (Zhang 2019)."""

    def forward(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        line = torch.tensor([0.25, 0.5, 0.25], dtype=x.dtype, device=x.device)
        kernel = (line[:, None] * line).expand(channels, 1, 3, 3)
        return F.conv2d(F.pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=channels)


def _relu() -> nn.ReLU:
    return nn.ReLU(inplace=True)


def _squeezenet() -> nn.Sequential:
    def pool() -> nn.MaxPool2d:
        return nn.MaxPool2d(3, stride=2, ceil_mode=True)

    fires = [Fire(64, 16, 64), Fire(128, 16, 64), pool(), Fire(128, 32, 128), Fire(256, 32, 128), pool()]
    fires += [Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)]
    return nn.Sequential(nn.Conv2d(3, 64, 3, stride=2), _relu(), pool(), *fires)


def _alexnet(shift_tolerant: bool) -> nn.Sequential:
    if shift_tolerant:  # strides become blurs; the first blur comes before its ReLU (ST-LPIPS)
        head = [nn.Conv2d(3, 64, 11, padding=2), BlurDownsample(), _relu(), nn.MaxPool2d(3, stride=1), BlurDownsample()]
        pool = [nn.MaxPool2d(3, stride=1), BlurDownsample()]
    else:
        head = [nn.Conv2d(3, 64, 11, stride=4, padding=2), _relu(), nn.MaxPool2d(3, stride=2)]
        pool = [nn.MaxPool2d(3, stride=2)]
    layers = [*head, nn.Conv2d(64, 192, 5, padding=2), _relu(), *pool]
    for channels, out in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(channels, out, 3, padding=1), _relu()]
    return nn.Sequential(*layers)


def _vgg16(shift_tolerant: bool) -> nn.Sequential:
    layers: list[nn.Module] = []
    channels = 3
    for block, (out, depth) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        if block:
            layers += [nn.MaxPool2d(2, stride=1), BlurDownsample()] if shift_tolerant else [nn.MaxPool2d(2, stride=2)]
        for _ in range(depth):
            layers += [nn.Conv2d(channels, out, 3, padding=1), _relu()]
            channels = out
    return nn.Sequential(*layers)


@dataclass(frozen=True)
class Architecture:
    """Where a network is tapped, each tap's channels, and the smallest side (pixels) at which every tap has a pixel."""

    taps: tuple[int, ...]
    channels: tuple[int, ...]
    smallest: int


ARCHITECTURES: dict[str, Architecture] = {
    "lpips-vgg": Architecture((3, 8, 15, 22, 29), (64, 128, 256, 512, 512), 16),
    "lpips-alex": Architecture((1, 4, 7, 9, 11), (64, 192, 384, 256, 256), 31),
    "lpips-squeeze": Architecture((1, 4, 7, 9, 10, 11, 12), (64, 128, 256, 384, 384, 512, 512), 17),
    "st-lpips-alex": Architecture((2, 6, 10, 12, 14), (64, 192, 384, 256, 256), 21),
    "st-lpips-vgg": Architecture((3, 9, 17, 25, 33), (64, 128, 256, 512, 512), 18),
}


def build_features(name: str) -> nn.Sequential:
    """The layers of a network in ARCHITECTURES, with PyTorch's own random weights."""
    shift_tolerant = name.startswith("st-")
    if name.endswith("squeeze"):
        return _squeezenet()
    return _alexnet(shift_tolerant) if name.endswith("alex") else _vgg16(shift_tolerant)
