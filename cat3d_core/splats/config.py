"""Settings of the splats, each with where its value comes from, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class SplatConfig:
    """3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024), with the losses and the trust in
    generated views of the robust Zip-NeRF. Lengths are in normalised scene units.

    Raises ValueError for settings that contradict each other.
    """

    # Optimisation
    iterations: int = 400
    window: int = 192
    """Pixels: of views that are larger, a step sees a square of this side, at random."""
    views_per_step: int = 1
    lr_means: float = 0.015
    lr_means_final: float = 0.0005
    """Means are moved in contracted coordinates (mip-NeRF 360 eq. 10): what is far moves as fast in an image."""
    lr_log_scales: float = 0.04
    lr_quaternions: float = 0.01
    lr_logits: float = 0.05
    lr_harmonics: float = 0.04
    lr_final: float = 0.3
    """Share of the other learning rates at the end; all fall logarithmically."""
    adam_beta1: float = 0.9
    adam_beta2: float = 0.99
    adam_eps: float = 1e-15
    max_skipped_steps: int = 10
    """Non-finite steps are skipped and counted; more than this many stop the training."""

    # Loss
    charbonnier_eps: float = 1e-3
    ssim_weight: float = 0.0
    lpips_weight: float = 0.02
    lpips_every: int = 2
    """Take the LPIPS loss at every k-th step only, its weight times k there."""
    depth_prior: float = 0.0
    """Weight of the loss on inverse depth where views come with depths."""
    depth_prior_until: float = 1.0
    """Share of the training over which that weight falls to 0."""
    patch_size: int = 64
    """Side of the square that the LPIPS loss sees of a window."""
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    """MCMC: mean opacity and mean scale (here relative to the distance from the scene's centre, at least 1)."""
    background: tuple[float, float] = (0.0, 1.0)
    """Grey level behind the scene: uniform per step."""

    # Trust in generated views, as for Zip-NeRF (see its config)
    distance_falloff: float = 15.0
    distance_unit: float = 1.0
    generated_weight_final: float = 0.5
    captured_share: float = 0.5

    # Gaussians
    degree: int = 0
    """Of the colour's spherical harmonics: 0 (the same from all sides) to 2."""
    start: int = 6000
    most: int = 12000
    shell: float = 0.1
    """Share of the first Gaussians that stands far behind the scene."""
    near: float = 0.3
    far: float = 30.0
    """Depths at which the first Gaussians are looked for, and distance of the shell."""
    start_opacity: float = 0.5
    grow: float = 1.05
    """MCMC: every time, 5 % more Gaussians, up to `most`."""
    density_every: int = 10
    density_until: float = 0.8
    """MCMC moves dead Gaussians and adds new ones every 100 of 30,000 steps; here there are a few hundred steps. After
    this share of the training it stops, so that they settle."""
    dead_opacity: float = 0.005
    noise: float = 0.1
    """Standard deviation of a step's noise in units of the Gaussian's own; it falls with the learning rate and with the
    opacity (MCMC eq. 8)."""
    antialias: bool = True

    def __post_init__(self) -> None:
        if min(self.iterations, self.window, self.views_per_step, self.start, self.lpips_every) < 1:
            raise ValueError("iterations, window, views_per_step, start and lpips_every are at least 1.")
        if self.most < self.start or self.grow < 1.0:
            raise ValueError("`most` is at least `start`, and `grow` at least 1.")
        if self.degree not in (0, 1, 2):
            raise ValueError(f"The colour's spherical harmonics have degree 0, 1 or 2, not {self.degree}.")
        if not 0.0 < self.near < self.far or not 0.0 <= self.shell < 1.0:
            raise ValueError("near and far are positive, far the larger, and shell lies in [0, 1).")
        if not (0.0 < self.lr_final <= 1.0 and 0.0 <= self.lr_means_final <= self.lr_means):
            raise ValueError("Learning rates fall: lr_final lies in (0, 1], lr_means_final in [0, lr_means].")
        if not (self.depth_prior >= 0.0 and 0.0 <= self.depth_prior_until <= 1.0):
            raise ValueError("depth_prior is at least 0, and depth_prior_until lies in [0, 1].")
        if not 0.0 < self.start_opacity < 1.0 or not 0.0 < self.dead_opacity < 1.0:
            raise ValueError("start_opacity and dead_opacity lie between 0 and 1.")


_FAST = SplatConfig()

PRESETS: dict[str, SplatConfig] = {
    "tiny": replace(_FAST, iterations=150, start=3000, most=4000),
    "fast": _FAST,
    "balanced": replace(_FAST, iterations=1500, start=10000, most=40000, density_every=20),
    # Kheradmand et al. 2024: 30,000 steps, a million Gaussians or more.
    "paper": replace(
        _FAST, iterations=30000, start=100_000, most=1_000_000, density_every=100, window=2048, degree=2,
        lr_means=0.0016, lr_means_final=0.000016, lr_log_scales=0.005, lr_quaternions=0.001, lr_harmonics=0.0025,
        ssim_weight=0.2, patch_size=128,
    ),
}  # fmt: skip
REFINE = replace(
    _FAST, iterations=500, lr_means=0.001, lr_means_final=0.0001, lr_quaternions=0.005, noise=0.0, density_every=0,
    lr_log_scales=0.02, lr_harmonics=0.02, opacity_weight=0.0, scale_weight=0.0, lpips_weight=0.0,
    background=(0.5, 0.5),
)  # fmt: skip
"""Splats that a field gave, on the field's own renders: their number stays, and they move a little. (A mip360 scene of
64 pixels: 27.5 dB without moving them, 28.3 dB with, the field itself 28.9 dB.)"""
