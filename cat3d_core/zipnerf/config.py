"""Settings of the reconstruction, each with where its value comes from, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ZipNerfConfig:
    """Robust Zip-NeRF. Defaults are the paper's few-view set-up (CAT3D app. 'Details of 3D Reconstruction').

    Lengths are in normalised scene units (mean camera distance about 1). 'Unstated' marks a value that neither CAT3D
    nor Zip-NeRF gives for this setting: ours, recorded here so that it can be ablated.
    Raises ValueError for settings that contradict each other.
    """

    # Optimisation
    iterations: int = 1000
    """CAT3D: 1,000. (Dense Zip-NeRF: 25,000.)"""
    batch_rays: int = 2**20
    """CAT3D: 1M few-view, 65k single image. Rounded to whole patches."""
    chunk_rays: int = 2**14
    """Rays differentiated at a time; gradients add up over the batch. Memory only, apart from the order of random
    draws."""
    lr_init: float = 0.04
    lr_final: float = 0.001
    """CAT3D: logarithmic decay from lr_init to lr_final."""
    warmup_iterations: int = 100
    """Unstated; Zip-NeRF warms up over a tenth of its training (sine, from warmup_scale)."""
    warmup_scale: float = 1e-8
    adam_beta1: float = 0.9
    adam_beta2: float = 0.99
    adam_eps: float = 1e-15
    """Zip-NeRF. A tiny eps is what lets the weight decay reach entries that no ray touches."""
    max_skipped_steps: int = 10
    """Non-finite steps are skipped and counted; more than this many stop the training."""

    # Loss
    charbonnier_eps: float = 1e-3
    lpips_weight: float = 0.25
    """CAT3D: 0.25 (single image, RealEstate10K, LLFF, DTU) or 1.0 (CO3D, mip-NeRF 360)."""
    patch_size: int = 128
    """CAT3D: 128 few-view, 32 single image. Used where a perceptual distance is given; else pixels are drawn singly."""
    patch_share: float = 1.0
    """Share of the rays drawn in patches, the rest singly. CAT3D: all. Less mixes views better when batches are
    small."""
    interlevel_weight: float = 0.01
    interlevel_blur: tuple[float, ...] = (0.03, 0.003)
    distortion_weight: float = 0.01
    distortion_power: float = -0.25
    distortion_premult: float = 1e4
    """Zip-NeRF 360: distortion of power_ladder(t, -0.25, 1e4)."""
    weight_decay: float = 0.1
    """Zip-NeRF: 0.1 * 0.5 * mean(v^2) of each grid level, summed over levels; applied in the optimiser."""

    near_gradient: bool = False
    """Scale gradients of samples at distance t from the camera by min(1, t^2), against floaters in front of cameras
    (Philip and Deschaintre 2023). The paper states none, and it depends on the scene: three views, 300 iterations of
    `fast`, llff_fern 24.8 -> 25.1 dB, re10k_bedroom 21.3 -> 20.5 dB."""

    # Trust in generated views
    distance_falloff: float = 15.0
    """CAT3D: the weight of a generated view is exp(-b s^2), b annealed linearly from 0 to this."""
    distance_unit: float = 1.0
    """Unstated unit of s, the distance of camera centres to the nearest captured one: here normalised scene units."""
    generated_weight_final: float = 0.5
    """Unstated: CAT3D anneals generated views globally; here their weight falls linearly from 1 to this."""
    captured_share: float = 0.1
    """Unstated: at least this share of patches and pixels comes from captured views (uniform over views where that
    gives more)."""

    # What is known of depths beforehand
    depth_prior: float = 0.0
    """Weight of the loss on inverse depth where views come with depths: those of runs with generated views, by the
    plane sweep. CAT3D has none."""
    depth_prior_until: float = 1.0
    """Share of the training over which that weight falls linearly to 0: views have the last word."""

    # Rays
    near: float = 0.0
    far: float = 1e6
    distance_power: float = -1.5
    distance_premult: float = 2.0
    """Zip-NeRF 360: power ladder of ray distance."""
    samples: tuple[int, ...] = (64, 64, 32)
    """Intervals per round; the last belongs to the radiance field, the others to the proposals."""
    multisamples: int = 6
    anneal_slope: float = 10.0
    background: tuple[float, float] = (0.0, 1.0)
    """Grey level behind the scene: uniform per ray in training, the mean in renderings."""

    # Field
    grid_base: int = 16
    grid_max: tuple[int, ...] = (512, 2048, 8192)
    grid_features: tuple[int, ...] = (1, 1, 4)
    grid_log2_table: int = 21
    grid_init: float = 1e-5
    grid_gain: float = 10.0
    """Zip-NeRF code: features are 10x the stored values ('preconditioning')."""
    density_bias: float = -1.0
    density_width: int = 64
    bottleneck_width: int = 256
    """Unstated for the few-view set-up; Zip-NeRF: 256."""
    view_width: int = 32
    view_depth: int = 1
    """CAT3D: view network of width 32 and depth 1. (Dense Zip-NeRF: 256, 3.)"""
    view_degree: int = 4
    rgb_padding: float = 1e-3

    # Skips: each costs or changes nothing at its default (measured in `cat3d bench reconstruct`)
    proposal_every: int = 1
    """Train the proposals at every k-th step (after warm-up); 1 as in Zip-NeRF."""
    lpips_every: int = 1
    """Draw patches for the perceptual loss at every k-th step only, its weight times k there; 1 as in CAT3D."""
    low_resolution_iterations: int = 0
    """Start on images of half the size for this many steps, without patches."""
    skip_transmittance: float = 0.0
    """Go along rays from front to back and do not query what less than this share of the light reaches: it adds at
    most that to a colour. In training in the final round only (and in proposals at steps that don't train them, see
    proposal_every), in renderings in all. 0: all is queried. Proposals leave little to skip: of a trained `fast` field
    12 to 17 % of the final intervals lie behind 99 % of the light, and on a CPU the bookkeeping costs as much."""
    skip_groups: int = 4
    """Groups of intervals in which it then goes along."""
    plateau_patience: int = 0
    """The schedule is cut short once this many checks in a row saw no lower error of held-out pixels; 0: never."""
    plateau_from: float = 0.0
    """Share of `iterations` before which no check is made."""
    plateau_every: int = 50
    plateau_pixels: int = 1024
    """Pixels of captured views that are then not trained on, drawn once; checked every plateau_every steps."""
    plateau_tolerance: float = 0.01
    """Share by which the error has to fall below the lowest so far to count; less is noise."""
    plateau_cooldown: float = 0.1
    """Share of `iterations` in which what is left of the schedule is then run through: without the fall of the
    learning rate a field stays noisy. 0: training stops at once."""

    def __post_init__(self) -> None:
        rounds = len(self.samples)
        if rounds < 1 or len(self.grid_max) != rounds or len(self.grid_features) != rounds:
            raise ValueError("samples, grid_max and grid_features need one entry per sampling round.")
        if len(self.interlevel_blur) < rounds - 1:
            raise ValueError(f"interlevel_blur needs an entry for each of the {rounds - 1} proposal rounds.")
        if self.iterations < 1 or self.batch_rays < 1 or self.chunk_rays < 1 or min(self.samples) < 2:
            raise ValueError("iterations, batch_rays and chunk_rays are at least 1, samples at least 2 per round.")
        if not 0.0 <= self.patch_share <= 1.0 or not 0.0 <= self.captured_share <= 1.0:
            raise ValueError("patch_share and captured_share lie in [0, 1].")
        if not (self.depth_prior >= 0.0 and 0.0 <= self.depth_prior_until <= 1.0):
            raise ValueError("depth_prior is at least 0, and depth_prior_until lies in [0, 1].")
        if not 0.0 < self.lr_final <= self.lr_init:
            raise ValueError("The learning rate falls: 0 < lr_final <= lr_init.")
        if min(self.proposal_every, self.lpips_every, self.plateau_every, self.skip_groups) < 1:
            raise ValueError("proposal_every, lpips_every, plateau_every and skip_groups are at least 1.")
        if not all(0.0 <= x < 1.0 for x in (self.skip_transmittance, self.plateau_tolerance)):
            raise ValueError("skip_transmittance and plateau_tolerance lie in [0, 1).")
        if not (0.0 <= self.plateau_cooldown <= 1.0 and 0.0 <= self.plateau_from <= 1.0):
            raise ValueError("plateau_cooldown and plateau_from lie in [0, 1].")

    @property
    def rounds(self) -> int:
        return len(self.samples)


_PAPER = ZipNerfConfig()

# For two CPU cores and small images: a scene in seconds (tiny), about half a minute (fast), or over ten minutes
# (balanced). One proposal round did as well as two at equal cost on fox (27.3 against 26.6 dB) and fern at 3 views
# (25.4 against 24.9). Half the samples cost 1.2 dB. Three multisamples instead of six cost nothing, and with small
# batches a learning rate that ends higher gains 0.3 dB: so 800 steps do what 1,000 did (docs/log/2026-11-29_speed.md).
_FAST = replace(
    _PAPER,
    iterations=800,
    warmup_iterations=80,
    lr_final=0.003,
    multisamples=3,
    batch_rays=1024,
    chunk_rays=1024,
    patch_size=24,  # LPIPS networks need 16 to 31 pixels; ST-LPIPS AlexNet, the default here, 21
    patch_share=0.5,
    # One small patch a step makes the LPIPS gradient so noisy that the paper's weight drowns the photometric loss:
    # llff_fern, 3 views, 101x76, 300 iterations: 24.7 dB without, 23.4 at 0.02, 18.9 at 0.25.
    lpips_weight=0.02,
    # The shipped model blurs: 3 photos and 24 generated views of five procedural scenes gave 23.5 dB with half of the
    # rays from the photos, 22.5 dB with a tenth.
    captured_share=0.5,
    # With the photos' confirmed depths, three photos: +0.35 dB on eight procedural scenes, +0.13 on seven captured ones
    # (docs/log/2026-11-29_depth.md).
    depth_prior=0.1,
    samples=(32, 16),
    grid_max=(128, 1024),
    grid_features=(1, 4),
    interlevel_blur=(0.03,),
    grid_log2_table=16,
    density_width=32,
    bottleneck_width=16,
)

PRESETS: dict[str, ZipNerfConfig] = {
    "tiny": replace(
        _FAST, iterations=100, warmup_iterations=10, lr_final=0.001, batch_rays=768, chunk_rays=768,
        samples=(16, 12), grid_max=(64, 128), grid_log2_table=14,
    ),
    "fast": _FAST,
    "balanced": replace(
        _FAST, iterations=2500, warmup_iterations=250, lr_final=0.001, multisamples=6,
        batch_rays=4096, chunk_rays=4096, patch_size=32,
        lpips_weight=0.1, samples=(48, 48, 24), grid_max=(256, 512, 2048), grid_features=(1, 1, 4),
        interlevel_blur=(0.03, 0.003),
        grid_log2_table=18, density_width=64,
    ),
    "paper": _PAPER,
}  # fmt: skip
