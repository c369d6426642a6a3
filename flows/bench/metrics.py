"""Metric implementations side by side: seconds and error of ours, scikit-image, torchmetrics and pytorch-msssim.

Every row is measured in one run on the same images, round robin, so that a busy machine slows all of them alike;
`error` is against the same quantity from float64 images.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cat3d_core.metrics.perceptual import find_perceptual
from cat3d_core.metrics.psnr import psnr
from cat3d_core.metrics.ssim import ssim
from flows.bench import counts, limits

Timed = Callable[[Tensor, Tensor], Tensor]
#: Work of a metric for images of so many numbers, whoever computes it.
WORK: dict[str, Callable[[int], limits.Work]] = {
    "psnr": counts.psnr, "ssim gaussian": lambda n: counts.ssim(n, 11), "ssim uniform": lambda n: counts.ssim(n, 7),
}  # fmt: skip


def image_pairs(views: int, height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A smooth picture with edges and a noisy copy, both (B, 3, H, W) float32 in [0, 1], rounded to 8 bits."""
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(views, 3, max(2, height // 32), max(2, width // 32), generator=g)
    target = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    prediction = (target + 0.03 * torch.randn(target.shape, generator=g)).clamp(0, 1)
    return (prediction * 255).round() / 255, (target * 255).round() / 255


def _per_view(measure: Callable[[np.ndarray, np.ndarray], float]) -> Timed:
    """A numpy metric of one (H, W, 3) pair as a batched one."""

    def batched(prediction: Tensor, target: Tensor) -> Tensor:
        pairs = zip(prediction.permute(0, 2, 3, 1).numpy(), target.permute(0, 2, 3, 1).numpy(), strict=True)
        return torch.tensor([measure(x, y) for x, y in pairs], dtype=torch.float64)

    return batched


def _implementations() -> dict[str, dict[str, Timed]]:
    """Metric -> implementation -> function, the packages only where they are installed. Ours comes first."""
    table: dict[str, dict[str, Timed]] = {
        "psnr": {"cat3d": psnr},
        "ssim gaussian": {"cat3d": ssim},
        "ssim uniform": {"cat3d": lambda x, y: ssim(x, y, "uniform_valid")},
    }
    try:
        from skimage import metrics as skimage

        gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        common: dict[str, Any] = {"channel_axis": 2, "data_range": 1.0}
        table["psnr"]["scikit-image"] = _per_view(lambda x, y: skimage.peak_signal_noise_ratio(y, x, data_range=1.0))
        table["ssim gaussian"]["scikit-image"] = _per_view(
            lambda x, y: skimage.structural_similarity(x, y, **common, **gaussian)
        )
        table["ssim uniform"]["scikit-image"] = _per_view(lambda x, y: skimage.structural_similarity(x, y, **common))
    except ImportError:
        pass
    try:
        from torchmetrics.functional import image as torchmetrics

        def cropped(x: Tensor, y: Tensor) -> Tensor:  # its own mean takes in a border of reflected pixels
            _, local = torchmetrics.structural_similarity_index_measure(
                x, y, data_range=1.0, reduction="none", return_full_image=True
            )
            return local[..., 5:-5, 5:-5].mean(dim=(1, 2, 3))

        table["psnr"]["torchmetrics"] = lambda x, y: torchmetrics.peak_signal_noise_ratio(
            x, y, data_range=1.0, reduction="none", dim=(1, 2, 3)
        )
        table["ssim gaussian"]["torchmetrics"] = cropped
    except ImportError:
        pass
    try:
        from pytorch_msssim import ssim as msssim

        table["ssim gaussian"]["pytorch-msssim"] = lambda x, y: msssim(x, y, data_range=1.0, size_average=False)
    except ImportError:
        pass
    return table


def rows(views: int = 4, height: int = 378, width: int = 504, repeats: int = 5) -> list[dict[str, Any]]:
    """One row a metric and implementation: metric, implementation, views, height, width, threads, `seconds_per_view`
    (best of `repeats`), `times_ours` (seconds / ours), `value` (mean over views), `error` (largest difference from the
    value of float64 images) and the shares of the machine's limits (`limits`). A perceptual distance is timed as well
    where weights are found, on one 128x128 patch (the paper's training patch), forward and, as "... gradient", with its
    gradient; it has no rival here (the packages need torchvision).
    """
    prediction, target = image_pairs(views, height, width)
    result = []
    for metric, implementations in _implementations().items():
        exact = implementations["cat3d"](prediction.double(), target.double())
        values = {name: run(prediction, target).double() for name, run in implementations.items()}  # also warms up
        best = dict.fromkeys(implementations, float("inf"))
        for _ in range(repeats):
            for name, run in implementations.items():
                start = time.perf_counter()
                run(prediction, target)
                best[name] = min(best[name], time.perf_counter() - start)
        for name in implementations:
            result.append(
                {
                    "metric": metric,
                    "implementation": name,
                    "seconds_per_view": best[name] / views,
                    "times_ours": best[name] / best["cat3d"],
                    "value": float(values[name].mean()),
                    "error": float((values[name] - exact).abs().max()),
                    **limits.columns(WORK[metric](target.numel()), best[name]),
                }
            )
    size = {"views": views, "height": height, "width": width, "threads": torch.get_num_threads()}
    return [row | size for row in result] + _perceptual_rows(prediction, target, repeats)


def _perceptual_rows(prediction: Tensor, target: Tensor, repeats: int) -> list[dict[str, Any]]:
    distance = find_perceptual()
    if distance is None:
        return []
    prediction, target = prediction[:1, :, :128, :128], target[:1, :, :128, :128]
    height, width = target.shape[2:]
    with torch.no_grad():
        value = distance(prediction, target).double()
        exact = distance.double()(prediction, target)
    distance = distance.float()
    result = []
    for name, needs_gradient in ((distance.name, False), (f"{distance.name} gradient", True)):
        best = float("inf")
        for _ in range(repeats):
            image = prediction.clone().requires_grad_(needs_gradient)
            start = time.perf_counter()
            _distance(distance, image, target, needs_gradient)
            best = min(best, time.perf_counter() - start)
        flops = counts.counted(functools.partial(_distance, distance, image, target, needs_gradient))
        work = limits.Work(flops, counts.network_bytes(distance) + 2 * counts.FLOAT * target.numel())
        result.append(
            {
                "metric": name,
                "implementation": "cat3d",
                "seconds_per_view": best,
                "times_ours": 1.0,
                "value": float(value.mean()),
                "error": float((value - exact).abs().max()),
                "views": 1,
                "height": height,
                "width": width,
                "threads": torch.get_num_threads(),
                **limits.columns(work, best),
            }
        )
    return result


def _distance(distance: Any, image: Tensor, target: Tensor, needs_gradient: bool) -> None:
    with torch.set_grad_enabled(needs_gradient):
        loss = distance(image, target).sum()
    if needs_gradient:
        loss.backward()
