"""What a scene may do without: the one place with all switches (rules and measurements: docs/explanation/skips.md)."""

from __future__ import annotations

from typing import Any

from pydantic import model_validator

from schemas.strict import StrictModel


class SkipConfig(StrictModel):
    """Work that a scene may not need, a switch for each; `skip: none` and `skip: all` set all of them.

    A switch that is off changes no result. What was skipped, why and what it saved is among the decisions of the
    stage. What the defaults save and cost: docs/explanation/skips.md.
    """

    coverage: bool = True
    """Plan: views that add nothing to the coverage of the scene."""
    covered_path: bool = True
    """Plan: all generated views, where captured views see what the path sees from nearly the same directions."""
    explained: bool = True
    """Sample: groups whose views the photos show in every place (see `hints`); they are what the photos show."""
    rounds: bool = False
    """Sample: groups are sampled in rounds, each where a briefly trained field knows least, as long as a round lowers
    its error in a held-out captured view."""
    near_steps: bool = False
    """Sample: half of the steps for groups near captured views."""
    guidance: bool = True
    """Sample: the unconditional half of the network outside the interval `sample.guidance_log_snr`."""
    solver: bool = True
    """Sample: steps beyond those the model's file recommends or, where it says nothing, a better solver needs for the
    error of the paper's 50 steps of DDIM."""
    detail: bool = True
    """Reconstruct: pixels of generated views finer than those of the finest captured view."""
    seen: bool = True
    """Reconstruct: pixels of generated views whose place two captured views show as well, and the share of rays that
    such pixels would have had; also all generated views, where such pixels are half of theirs and there are more than
    three captured views."""
    empty_space: bool = False
    """Reconstruct, render: queries of the field behind what stops all but a hundredth of a ray's light."""
    proposals: bool = True
    """Reconstruct: training of the proposals at all but every fourth step."""
    lpips: bool = False
    """Reconstruct: the LPIPS loss at every second step."""
    rays: bool = True
    """Reconstruct: rays of a step beyond a 24th of all pixels, where few views are trained on, and a quarter of them
    where views are generated and the training is long."""
    low_resolution: bool = False
    """Reconstruct: full resolution, and with it the LPIPS loss, in the first eighth of the steps."""
    plateau: bool = True
    """Reconstruct: what is left of the steps when held-out pixels no longer improve, but for a cool-down."""
    workers: bool = True
    """Sample, decode: worker processes for what this one has done before they would have started."""

    @model_validator(mode="before")
    @classmethod
    def _all_or_none(cls, value: Any) -> Any:
        if value in ("all", "none"):
            return dict.fromkeys(cls.model_fields, value == "all")
        return value
