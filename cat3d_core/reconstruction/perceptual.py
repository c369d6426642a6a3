"""The network of the perceptual loss, where one is wanted and can be used."""

from __future__ import annotations

from cat3d_core.decision import Decision
from cat3d_core.metrics.perceptual import PerceptualDistance, find_perceptual


def perceptual_loss(weight: float, patch_size: int) -> tuple[PerceptualDistance | None, list[Decision]]:
    """The network of a loss of this weight on patches of this many pixels a side, or why there is none."""
    if weight == 0:
        return None, []
    found = find_perceptual()
    if found is None:
        text = "No perceptual network was found on this machine: trained without the LPIPS loss."
        return None, [Decision("warning", text)]
    smallest = found.architecture.smallest
    if patch_size < smallest:
        text = f"Trained without the LPIPS loss: {found.name} needs patches of {smallest} pixels, and these are "
        return None, [Decision("warning", f"{text}{patch_size}.")]
    return found, []
