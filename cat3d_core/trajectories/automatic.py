"""Choosing a recipe from the captured cameras (beyond the paper, whose trajectories are chosen by hand)."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.normalization import axes_intersection
from cat3d_core.trajectories.frame import CENTRAL_OBJECT, SceneFrame, central_object

# Viewing directions within this of each other count as looking one way.
ONE_WAY_DEG = 32.0
# Motion along the viewing axis over motion across it: above this the camera walks rather than sways.
WALKING = 0.4
# ... provided it comes this much nearer or farther (rms, in units of the scene's distance).
STRIDE = 0.04
# Azimuths covered (the circle less its widest gap): above this the cameras stand around the scene.
AROUND_DEG = 180.0
# Spread of the elevations over that of the azimuths (or the reverse): below this the views lie on an arc.
ARC = 0.35


def choose_recipe(captured: Cameras, frame: SceneFrame, points: Tensor | None = None) -> tuple[str, list[str]]:
    """Name of the recipe that fits the captured cameras, and why, in sentences.

    Decided in this order: one view (or coincident ones that look one way): spiral, or orbit where the points show a
    central object. Views that look one way: forward-facing (llff), or a walk (realestate10k) when they move mostly
    along the viewing axis. Views without a common point in front of them: a walk. Views around a centre: mipnerf360
    when they go round it, co3d when they lie on an arc, else dtu.
    """
    directions = captured.forward
    spread = torch.rad2deg(torch.acos((directions @ directions.T).clamp(-1, 1)).max()).item()
    offset = captured.centers - captured.centers.mean(0)
    extent = float(offset.square().sum(-1).mean().sqrt()) / frame.distance
    if len(captured) == 1 or (extent < 1e-6 and spread < ONE_WAY_DEG):
        return _single(captured, frame, points)
    if extent < 1e-6:
        return "realestate10k", [
            f"The {len(captured)} captured views turn by {spread:.0f} degrees on one spot, which shows no depth; "
            "a spline through them, shifted sideways and ahead, adds the missing parallax."
        ]
    if spread < ONE_WAY_DEG:
        return _one_way(captured, frame, offset, spread)
    center = axes_intersection(captured)
    if center is None:
        return "realestate10k", [
            f"The {len(captured)} captured views look up to {spread:.0f} degrees apart and share no point in front "
            "of them, as on a walk through a space: splines through them, shifted sideways and ahead."
        ]
    return _around(captured, frame, center, spread)


def _single(captured: Cameras, frame: SceneFrame, points: Tensor | None) -> tuple[str, list[str]]:
    who = "One captured view" if len(captured) == 1 else "All captured views are at one place"
    found = central_object(captured, points)
    ratio = found[0] if found is not None else None
    if ratio is not None and ratio > CENTRAL_OBJECT:
        return "single_orbit", [
            f"{who}; the surroundings are {ratio:.1f} times as deep as the middle of the image: a central object, so "
            "an orbit round it."
        ]
    why = (
        "there are no points that show a central object"
        if ratio is None
        else f"the surroundings are only {ratio:.1f} times as deep as the middle of the image, so no central object"
    )
    reasons = [f"{who}, and {why}: spiral into and out of the scene."]
    if not frame.scale_known:
        reasons.append("The distance to the scene is unknown and taken as 1 world unit; give depth to set it.")
    return "single_spiral", reasons


def _one_way(captured: Cameras, frame: SceneFrame, offset: Tensor, spread: float) -> tuple[str, list[str]]:
    along = offset @ frame.forward
    across = (offset - along[:, None] * frame.forward).square().sum(-1).mean().sqrt()
    stride = float(along.square().mean().sqrt())
    ratio = stride / max(float(across), 1e-9 * frame.distance)
    seen = f"The {len(captured)} captured views look one way (directions within {spread:.0f} degrees) and move "
    if ratio > WALKING and stride > STRIDE * frame.distance:
        return "realestate10k", [
            f"{seen}{ratio:.2f} times as much along the viewing axis as across it: a walk, so splines through them, "
            "shifted sideways and ahead."
        ]
    return "llff", [f"{seen}mostly across the viewing axis ({ratio:.2f} along): forward-facing circles."]


def _around(captured: Cameras, frame: SceneFrame, center: Tensor, spread: float) -> tuple[str, list[str]]:
    out = captured.centers - center
    out = out / out.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    azimuth = torch.rad2deg(torch.atan2(out @ frame.ahead, out @ frame.right)).sort().values
    elevation = torch.rad2deg(torch.asin((out @ frame.up).clamp(-1, 1)))
    gaps = torch.cat([azimuth.diff(), azimuth[:1] + 360 - azimuth[-1:]])
    around = 360 - float(gaps.max())
    # Spread across the arc over that along it; azimuths are counted from the far side of the widest gap.
    begin = azimuth[(int(gaps.argmax()) + 1) % len(azimuth)]
    level = ((azimuth - begin) % 360).std(correction=0) * torch.deg2rad(elevation.mean()).cos()
    high = elevation.std(correction=0)
    flat = float(torch.minimum(level, high) / torch.maximum(level, high).clamp(min=1e-9))
    seen = f"The {len(captured)} captured views look at a common centre (directions within {spread:.0f} degrees) "
    if around > AROUND_DEG:
        return "mipnerf360", [
            f"{seen}from azimuths that cover {around:.0f} of 360 degrees: ellipses all round the scene."
        ]
    if flat < ARC or len(captured) < 3:
        return "co3d", [
            f"{seen}along an arc of {around:.0f} degrees (spread across the arc {flat:.2f} of that along it): splines "
            "through the views, scaled about the centre."
        ]
    return "dtu", [
        f"{seen}from one side ({around:.0f} degrees of azimuth, spread both ways, ratio {flat:.2f}): circles across "
        "the mean viewing direction, a partial orbit."
    ]
