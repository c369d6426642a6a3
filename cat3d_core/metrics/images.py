"""What image metrics share: the check of their arguments, and the kernels of images.cpp."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from cat3d_core.cpu_library import library


def kernels_for(prediction: Tensor, target: Tensor) -> ctypes.CDLL | None:
    """The kernels, if they take these images: float32 on the CPU, and nobody asks for gradients."""
    wanted = torch.is_grad_enabled() and (prediction.requires_grad or target.requires_grad)
    plain = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in (prediction, target))
    return library("metrics/images") if plain and not wanted else None


def image_pair(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Check two batches of images and widen half precision.

    prediction, target (B, C, H, W), floating point, values in [0, 1]; mask (B, H, W), bool or weights in [0, 1].
    Returns them in float32, or float64 if one of them is (the mask too). No value is looked at, so that nothing waits
    for the device. Raises ValueError for another rank, integer images, unequal shapes or an empty batch.
    """
    for name, image in (("prediction", prediction), ("target", target)):
        if image.ndim != 4:
            raise ValueError(f"The {name} has shape {tuple(image.shape)}; expected a batch of images (B, C, H, W).")
        if not image.is_floating_point():
            raise ValueError(
                f"The {name} is {image.dtype}; expected floating point in [0, 1] (divide uint8 images by 255 first)."
            )
    if prediction.shape != target.shape:
        raise ValueError(
            f"The prediction {tuple(prediction.shape)} and the target {tuple(target.shape)} differ in shape; "
            "render at the target's resolution."
        )
    if prediction.numel() == 0:
        raise ValueError(f"Images of shape {tuple(prediction.shape)} hold no pixels; there is nothing to measure.")
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    if mask is not None:
        expected = (prediction.shape[0], *prediction.shape[2:])
        if tuple(mask.shape) != expected:
            raise ValueError(f"The mask has shape {tuple(mask.shape)}; expected {expected}, one weight a pixel.")
        mask = mask.to(device=prediction.device, dtype=dtype)
    return prediction.to(dtype), target.to(dtype), mask
