"""Named evaluation protocols: which PSNR, SSIM and LPIPS a published number means.

Few-view papers quote one column name for different quantities: the SSIM window, its data range, rounding to 8 bits, the
range that LPIPS is fed and what happens outside a mask all differ, by more than most methods do. A number from here
carries its protocol's name.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.metrics.images import image_pair
from cat3d_core.metrics.perceptual import PerceptualDistance
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim


@dataclass(frozen=True)
class Protocol:
    """One convention. No protocol crops the images; a `valid` SSIM window leaves out the border of the SSIM map.

    quantize: "none"; "round" to 8 bits as an image writer does; "truncate" (floor of 255 x). Both images.
    ssim_window, ssim_data_range: as in `ssim`.
    lpips: the network that its published numbers use, "" where none was published.
    lpips_normalize: whether LPIPS is fed [-1, 1] (as it was trained) or [0, 1] as is.
    mask: what a mask means. "none": the protocol defines none, giving one is an error. "white": PSNR over the pixels
        where the mask is 1, the others after compositing both images on white. "black": both images times the mask.
    """

    name: str
    source: str
    quantize: str = "none"
    ssim_window: str = "gaussian_valid"
    ssim_data_range: float = 1.0
    lpips: str = "lpips-vgg"
    lpips_normalize: bool = True
    mask: str = "none"


_ALL = (
    # camp_zipnerf's eval.py rounds the rendering to 8 bits first: the same for renderings read back from a store.
    Protocol("google", "camp_zipnerf, multinerf: image_utils.MetricHarness with dm_pix.ssim"),
    # scikit-image took 2 for the range of float images when none was given. It inflates SSIM; it is the convention.
    Protocol(
        "regnerf",
        "google-research/regnerf eval.py",
        ssim_window="uniform_valid",
        ssim_data_range=2.0,
        lpips="",
        mask="white",
    ),
    Protocol("freenerf", "FreeNeRF eval.py", ssim_window="uniform_valid", lpips_normalize=False, mask="white"),
    Protocol(
        "3dgs",
        "graphdeco-inria/gaussian-splatting metrics.py, on PNG files",
        quantize="round",
        ssim_window="gaussian_same",
        lpips_normalize=False,
    ),
    Protocol("nerfbaselines", "nerfbaselines metrics.py", quantize="truncate", lpips="lpips-alex", mask="black"),
)
PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in _ALL}


def quantize(images: Tensor, how: str) -> Tensor:
    """Images in [0, 1] after a trip through 8 bits, as float again: "none", "round" (half up) or "truncate"."""
    if how == "none":
        return images
    return torch.floor(images * 255.0 + (0.5 if how == "round" else 0.0)).clamp(0.0, 255.0) / 255.0


def _on_white(images: Tensor, mask: Tensor) -> Tensor:
    return images * mask[:, None] + (1.0 - mask[:, None])


def _check_view(prediction: Tensor, target: Tensor, mask: Tensor | None) -> None:
    for name, image in (("prediction", prediction), ("target", target)):
        if not bool(image.isfinite().all()):
            raise ValueError(f"The {name} holds NaN or infinite pixels; no metric is defined on it.")
    low, high = float(target.min()), float(target.max())
    if low < -1e-3 or high > 1.001:
        raise ValueError(f"The target has values in [{low:.3g}, {high:.3g}]; expected [0, 1].")
    if mask is not None and not bool((mask == 1).any()):
        raise ValueError("The mask selects no pixel; leave the view out.")


@torch.no_grad()
def evaluate(
    protocol: str | Protocol,
    prediction: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    perceptual: PerceptualDistance | None = None,
) -> dict[str, float]:
    """The metrics of one view under a protocol: "psnr" in dB (inf for identical images), "ssim" and, with a perceptual
    distance, its name ("lpips-vgg", "st-lpips-alex", ...: the column says what was measured).

    prediction, target (3, H, W) in [0, 1], on any device; the prediction is clamped to it. mask (H, W), bool or in
    [0, 1]: the numbers are then the masked ones. Raises ValueError for an unknown protocol, a mask under a protocol
    that defines none, non-finite pixels, an empty mask, a target outside [0, 1], and as `ssim` and the perceptual
    distance do for small images.
    """
    if isinstance(protocol, str):
        if protocol not in PROTOCOLS:
            raise ValueError(f"There is no metric protocol '{protocol}'; choose one of {', '.join(PROTOCOLS)}.")
        protocol = PROTOCOLS[protocol]
    if mask is not None and protocol.mask == "none":
        masked = ", ".join(p.name for p in _ALL if p.mask != "none")
        raise ValueError(f"The protocol '{protocol.name}' defines no masked metrics; use one of {masked}, or no mask.")
    if prediction.ndim != 3 or target.ndim != 3:
        raise ValueError("evaluate takes one view (3, H, W), not a batch; call it for each view.")
    prediction, target, mask = image_pair(prediction[None], target[None], None if mask is None else mask[None])
    _check_view(prediction, target, mask)
    prediction, target = (quantize(image.clamp(0.0, 1.0), protocol.quantize) for image in (prediction, target))
    whole_prediction, whole_target, counted = prediction, target, None
    if mask is not None and protocol.mask == "white":
        counted = mask == 1
        prediction, target = _on_white(prediction, mask), _on_white(target, mask)
    elif mask is not None:
        prediction, target = prediction * mask[:, None], target * mask[:, None]
        whole_prediction, whole_target = prediction, target
    result = {
        "psnr": float(psnr(whole_prediction, whole_target, counted)),
        "ssim": float(ssim(prediction, target, protocol.ssim_window, protocol.ssim_data_range)),
    }
    if perceptual is not None:
        result[perceptual.name] = float(perceptual(prediction, target, normalize=protocol.lpips_normalize))
    return result
