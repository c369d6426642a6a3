"""The metrics that the pipeline measures of each held-out view, and the one place to add one.

A metric is a function of a `Comparison` and a line in METRICS that says its name, unit, digits, which way is better and
what it means. The columns of the tables, the summary, the comparison of two results and the report follow from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.metrics import clip
from cat3d_core.metrics.depth import depth_errors
from cat3d_core.metrics.geometry import chamfer_distance
from cat3d_core.metrics.perceptual import find_perceptual, perceptual_name
from cat3d_core.metrics.protocols import evaluate
from cat3d_core.synthetic.dataset import surface_points

#: Surfaces further from the scene's origin than this (scene units) don't count in surface_chamfer.
RADIUS = 2.0
#: Points of each surface that are compared at most: every pair of them is measured.
SURFACE_POINTS = 4096


@dataclass(frozen=True)
class Network:
    """A network that metrics need and a machine may lack. name(): which one this machine has, or None; load(): that
    one, or None, its attribute `name` tells which; column: where tables name it; missing: a sentence for where it
    lacks."""

    key: str
    column: str
    meaning: str
    missing: str
    name: Callable[[], str | None]
    load: Callable[[], Any]


@dataclass(frozen=True)
class Comparison:
    """A rendered view beside the truth, under a protocol: all that a metric may look at.

    image, truth (3, H, W) in [0, 1]; mask (H, W) or None for none. depth, opacity (H, W): rendered; true_depth (h, w):
    true z-depth, inf where there is no surface, both in scene units, or None where it isn't known; camera: of the view.
    networks: those that are there, by key.
    """

    protocol: str
    image: Tensor
    truth: Tensor
    mask: Tensor | None = None
    depth: Tensor | None = None
    opacity: Tensor | None = None
    true_depth: Tensor | None = None
    camera: Cameras | None = None
    networks: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def under_protocol(self) -> dict[str, float]:
        """What the protocol defines: see `protocols.evaluate`."""
        return evaluate(self.protocol, self.image, self.truth, self.mask, self.networks.get(PERCEPTUAL.key))

    @cached_property
    def depths(self) -> tuple[Tensor, Tensor] | None:
        """Rendered and true z-depth (H, W) float64, where the truth shows a surface at all."""
        if self.depth is None or self.true_depth is None:
            return None
        places = zip(self.depth.shape, self.true_depth.shape, strict=True)
        rows, columns = (((torch.arange(n).double() + 0.5) * m / n).long() for n, m in places)
        exact = self.true_depth[rows][:, columns].double()
        return self.depth.double(), exact


@dataclass(frozen=True)
class Metric:
    """name: the column, with its unit where that is not 1 or the scene's. title: for people. digits: after the point.

    measure(comparison): the number, or None where it does not apply. of_protocol: whether it differs between protocols;
    in_paper: whether it is one of the paper's Table 1.
    """

    name: str
    title: str
    unit: str
    better: Literal["higher", "lower"]
    digits: int
    meaning: str
    measure: Callable[[Comparison], float | None]
    network: Network | None = None
    of_protocol: bool = False
    in_paper: bool = False


PERCEPTUAL = Network(
    "perceptual", "lpips_backbone", "network and weights of lpips",
    "No perceptual network on this machine, or lpips is off: the lpips column is empty.",
    perceptual_name, find_perceptual,
)  # fmt: skip
CLIP = Network(
    "clip", "clip_network", "image tower and weights of clip_score",
    f"No CLIP weights ({clip.VARIABLE} names a file of them): the clip_score column is empty.",
    lambda: getattr(clip.find_clip(), "name", None), clip.find_clip,
)  # fmt: skip


def psnr(view: Comparison) -> float:
    """Peak signal-to-noise ratio, dB."""
    return view.under_protocol["psnr"]


def ssim(view: Comparison) -> float:
    """Structural similarity."""
    return view.under_protocol["ssim"]


def lpips(view: Comparison) -> float | None:
    """Perceptual distance by the network that is there."""
    network = view.networks.get(PERCEPTUAL.key)
    return view.under_protocol[network.name] if network is not None else None


def clip_score(view: Comparison) -> float | None:
    """Cosine of the CLIP embeddings of render and photo."""
    network = view.networks.get(CLIP.key)
    return float(network.score(view.image[None], view.truth[None])) if network is not None else None


def depth_abs_rel(view: Comparison) -> float | None:
    """Mean |z - z_true| / z_true where there is a true surface."""
    if view.depths is None or not bool(view.depths[1].isfinite().any()):
        return None
    found, exact = view.depths
    return float(depth_errors(found[None], exact[None])["abs_rel"])


def surface_chamfer(view: Comparison) -> float | None:
    """Mean of both ways' distances between the surfaces that render (where it is opaque) and truth show."""
    if view.depths is None or view.opacity is None or view.camera is None:
        return None
    found, exact = view.depths
    found = found.where(view.opacity >= 0.5, torch.inf)
    surfaces = [_surface(z, view.camera) for z in (found, exact)]
    if not all(len(points) for points in surfaces):
        return None
    return float(chamfer_distance(surfaces[0], surfaces[1])["chamfer"])


def _surface(depth: Tensor, camera: Cameras) -> Tensor:
    """(P, 3) points near the scene's origin that the view sees, evenly thinned out; depth inf: nothing there."""
    points = surface_points(depth[None], camera)
    points = points[points.norm(dim=-1) <= RADIUS]
    return points[:: max(1, -(-len(points) // SURFACE_POINTS))]


METRICS: tuple[Metric, ...] = (
    Metric("psnr_db", "PSNR", "dB", "higher", 2, "peak signal-to-noise ratio, sRGB, peak 1", psnr,
           of_protocol=True, in_paper=True),
    Metric("ssim", "SSIM", "1", "higher", 3, "structural similarity as the protocol defines it", ssim,
           of_protocol=True, in_paper=True),
    Metric("lpips", "LPIPS", "1", "lower", 3, "perceptual distance by the named backbone", lpips, PERCEPTUAL,
           of_protocol=True, in_paper=True),
    Metric("clip_score", "CLIP score", "1", "higher", 3, "cosine of CLIP embeddings, render against photo", clip_score,
           CLIP),
    Metric("depth_abs_rel", "depth error", "1", "lower", 3, "mean |z - z_true| / z_true where the truth is known",
           depth_abs_rel),
    Metric("surface_chamfer", "surface error", "scene units", "lower", 3, "mean of both ways' distances between "
           "rendered and true surface points of the view, as far as 2 scene units from the origin", surface_chamfer),
)  # fmt: skip


def networks(metrics: tuple[Metric, ...]) -> list[Network]:
    """The networks that the metrics need, each once."""
    return list(dict.fromkeys(metric.network for metric in metrics if metric.network is not None))


def measure(views: list[Comparison], metrics: tuple[Metric, ...]) -> list[dict[str, float | None]]:
    """A row {metric: number} for each comparison of one view under several protocols; what does not depend on the
    protocol is measured once."""
    once = {m.name: m.measure(views[0]) for m in metrics if not m.of_protocol} if views else {}
    return [once | {m.name: m.measure(view) for m in metrics if m.of_protocol} for view in views]
