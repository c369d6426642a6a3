"""What photos show of target views: the function that the rest of the project calls."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.matching.network import SweepNetwork, camera_distance, partners
from cat3d_core.matching.photos import Observed
from cat3d_core.matching.planes import inverse_depth_of
from cat3d_core.matching.warp import views

#: Photos that a target is swept through, at most; the nearest are taken. The network was trained with up to as many.
AT_MOST = 9


@dataclass(frozen=True)
class Hint:
    """What the photos show of N targets, float32, all at the targets' resolution.

    colour (N, 3, H, W) in [0, 1]; confidence (N, H, W) in [0, 1]: how right the colour is expected to be, about
    exp(-mean absolute error / 0.06); inverse_depth (N, H, W): expected 1 / z-depth in the unit of the cameras (0 is
    infinitely far), and spread (N, H, W), its standard deviation; seen (N, H, W) in [0, 1]: probability that the place
    lies inside some photo's image; photos (N, M) int64: which photos were used, and share (N, M, H, W): how much of the
    colour comes from each (sums to 1).
    """

    colour: Tensor
    confidence: Tensor
    inverse_depth: Tensor
    spread: Tensor
    seen: Tensor
    photos: Tensor
    share: Tensor


@torch.no_grad()
def observe(network: SweepNetwork, image: Tensor, cameras: Cameras) -> Observed:
    """Look at the photos of one scene, once for all its targets (see `hint`).

    image (M, 3, H, W) in [0, 1], sides divisible by 16; cameras: M, of the normalised scene, of that size.
    Raises ValueError for sides that 16 does not divide, or cameras that do not fit the photos."""
    if len(image) == 0 or len(image) != len(cameras):
        raise ValueError(
            f"{len(image)} photos come with {len(cameras)} cameras; each photo needs one, and there has to be one."
        )
    _side(image.shape[-1], image.shape[-2])
    device = network.target.score.weight.device
    seen = views(cameras.to(device))
    return network.observe(image.to(device, torch.float32), seen, partners(seen.pose, network.config.partners))


@torch.no_grad()
def hint(network: SweepNetwork, observed: Observed, targets: Cameras, chunk: int = 4) -> Hint:
    """What the photos show of the target views: geometry first (there is no such step in the paper).

    observed: from `observe`; targets: N cameras in the photos' unit, of one size, sides divisible by 16, worked on in
    chunks of `chunk`. The order of the photos does not matter, and any number of them will do: each target takes the
    nearest AT_MOST. Raises ValueError for targets of several sizes."""
    if len(targets) == 0 or bool((targets.size != targets.size[0]).any()):
        raise ValueError("A hint is made for one or more target cameras of one image size.")
    width, height = (int(s) for s in targets.size[0])
    _side(width, height)
    target = views(targets.to(observed.image.device))
    near = camera_distance(target.pose, observed.views.pose).argsort(1)[:, :AT_MOST]
    parts = []
    for start in range(0, len(near), chunk):
        rows = slice(start, start + chunk)
        out = network(observed, near[rows], target[rows], height, width)
        parts.append(
            (out.colour.clamp(0, 1), out.confidence[:, 0].sigmoid(), out.inverse_depth[:, 0], out.spread[:, 0],
             out.seen[:, 0], near[rows], out.share)
        )  # fmt: skip
    return Hint(*(torch.cat(column) for column in zip(*parts, strict=True)))


def photo_depth(network: SweepNetwork, observed: Observed) -> tuple[Tensor, Tensor]:
    """The photos' own inverse depth (M, H/2, W/2), as the sweep found it, and its expected absolute error there."""
    nearest = network.config.nearest
    position, error = observed.position[:, 0], observed.log_spread[:, 0].exp()
    low, high = (inverse_depth_of((position + sign * error).clamp(0, 1), nearest) for sign in (-1, 1))
    return inverse_depth_of(position, nearest), (high - low) / 2


def _side(width: int, height: int) -> None:
    if width % 16 or height % 16:
        raise ValueError(f"The plane sweep works on sides divisible by 16, and these are {width} x {height} pixels.")
