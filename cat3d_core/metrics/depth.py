"""Depth error where the true depth is known."""

from __future__ import annotations

import torch
from torch import Tensor


def depth_errors(
    prediction: Tensor, target: Tensor, mask: Tensor | None = None, align: str = "none"
) -> dict[str, Tensor]:
    """Errors of depth maps over the pixels where the target is positive and finite (and the mask is set).

    prediction, target (B, H, W), in one unit of length; mask (B, H, W) bool. align "none", or "median": the prediction
    is first multiplied by the ratio of medians (for a depth known up to scale). Returns (B,) float64 each (Eigen et al.
    2014): "abs_rel" mean |p - t| / t; "rmse" in the unit of the depths; "delta_1.25" the share of pixels with
    max(p/t, t/p) < 1.25.
    Raises ValueError for unequal shapes, a view without a valid pixel, or a prediction that isn't finite there.
    """
    if prediction.shape != target.shape or prediction.ndim != 3:
        raise ValueError(
            f"Depth maps have shapes {tuple(prediction.shape)} and {tuple(target.shape)}; expected both (B, H, W)."
        )
    if align not in ("none", "median"):
        raise ValueError(f"There is no depth alignment '{align}'; choose none or median.")
    valid = target.isfinite() & (target > 0)
    if mask is not None:
        valid &= mask.to(torch.bool)
    columns: dict[str, list[Tensor]] = {"abs_rel": [], "rmse": [], "delta_1.25": []}
    for view in range(target.shape[0]):
        p, t = prediction[view][valid[view]].double(), target[view][valid[view]].double()
        if t.numel() == 0:
            raise ValueError(f"View {view} has no pixel with a known depth; leave the view out.")
        if not bool(p.isfinite().all()):
            raise ValueError(f"The predicted depth of view {view} holds NaN or infinity where the true depth is known.")
        if align == "median":
            if not bool(p.median() > 0):
                raise ValueError(f"The predicted depth of view {view} has no positive median; it can't be aligned.")
            p = p * (t.median() / p.median())
        columns["abs_rel"].append(((p - t).abs() / t).mean())
        columns["rmse"].append((p - t).square().mean().sqrt())
        columns["delta_1.25"].append(((p < 1.25 * t) & (t < 1.25 * p)).double().mean())
    return {name: torch.stack(values) for name, values in columns.items()}
