"""Whether what the photos show is carried into generated views, and by which plane sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from schemas.strict import StrictModel


class HintsConfig(StrictModel):
    """What the photos show of the planned views, carried there by geometry before anything is sampled.

    A plane sweep finds for each pixel of a planned view its depth, its colour in the photos and how far that is to be
    trusted. The paper has no such step (docs/explanation/geometry.md).
    """

    use: Literal["auto", "always", "never"] = "auto"
    """`auto`: with the shipped model, which was measured with them; other models go without."""
    checkpoint: Path | None = None
    """Weights of the plane sweep; None: the ones shipped."""
