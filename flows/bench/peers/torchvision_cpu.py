"""torchvision beside a torch without CUDA: its binary does not load there, but what the peers use of it is Python."""

from __future__ import annotations

import torch

_kept: list[torch.library.Library] = []  # what a library defines goes when the library does


def allow_torchvision() -> None:
    """Name the two operators of torchvision that its Python part expects, where its binary did not bring them."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        library = torch.library.Library("torchvision", "FRAGMENT")
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _kept.append(library)
