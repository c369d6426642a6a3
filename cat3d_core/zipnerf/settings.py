"""Which settings a Zip-NeRF is trained with: a preset, what the scene and the skips change of it, what is asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from cat3d_core.decision import Decision
from cat3d_core.reconstruction.protocol import ReconstructionRequest
from cat3d_core.reconstruction.views import Views
from cat3d_core.zipnerf.config import PRESETS, ZipNerfConfig

#: `skip.rays`: so many steps see as many rays as there are pixels, at least.
PASSES = 24
#: `skip.rays`: the fewest rays of a step.
FEWEST_RAYS = 256
#: `skip.rays` with generated views, whose pixels are many and uncertain: a step does with this share of its rays.
GENERATED_SHARE = 0.75
#: ... if all steps together still see so many times as many rays as there are pixels: short trainings need them all
#: (150 steps: up to 1.2 dB).
LEAST_PASSES = 2
#: `skip.plateau` with more captured views than this: their pixels tell how well other views are met, so training goes
#: on for as long as they improve at all. (With few views they only tell how well those are remembered.)
FEW_VIEWS = 9
PATIENT: dict[str, Any] = {"plateau_patience": 3, "plateau_every": 50, "plateau_tolerance": 0.01, "plateau_from": 0.0}
#: `skip.plateau` with generated views, which go on to shape what captured views don't show when those are learned
#: already: no end is looked for before this share of the steps, and the learning rate falls over that one.
GENERATED: dict[str, Any] = {"plateau_from": 0.4, "plateau_cooldown": 0.2}
#: CAT3D: LPIPS weight 1 on CO3D and mip-NeRF 360, 0.25 elsewhere.
STRONG_LPIPS = 4.0
STRONG_LPIPS_DATASETS = ("co3d", "mip360", "mipnerf360")
#: Settings younger than stored fields: at their defaults they are left out of what identifies a field, so that those
#: stay what is wanted.
YOUNGER = ("depth_prior", "depth_prior_until")


def skip_settings(iterations: int) -> dict[str, dict[str, Any]]:
    """The settings that each switch of the configuration's section `skip` turns on."""
    return {
        "empty_space": {"skip_transmittance": 0.01},
        "proposals": {"proposal_every": 4},
        "lpips": {"lpips_every": 2},
        "low_resolution": {"low_resolution_iterations": iterations // 8},
        "plateau": {"plateau_patience": 2, "plateau_every": 25, "plateau_tolerance": 0.1},
    }


def chosen_config(request: ReconstructionRequest) -> ZipNerfConfig:
    """The preset with the method's and family's LPIPS weight, what the run skips, and its overrides.

    Raises ValueError naming a preset or setting that there isn't, or a bad value.
    """
    if request.preset not in PRESETS:
        raise ValueError(f"preset: {request.preset!r} is none of zipnerf's; those are {', '.join(PRESETS)}.")
    config = PRESETS[request.preset]
    if not request.generated:
        # The paper's baseline has no perceptual loss: captured views agree with each other. (Measured on llff_fern, 3
        # views, 101x76, 300 iterations of `fast`: 24.7 dB without, 18.9 dB with.) Its views come without depths.
        config = dataclasses.replace(config, lpips_weight=0.0, depth_prior=0.0)
    elif request.dataset in STRONG_LPIPS_DATASETS:
        config = dataclasses.replace(config, lpips_weight=STRONG_LPIPS * config.lpips_weight)
    iterations = request.overrides.get("iterations", config.iterations)
    off = ZipNerfConfig()  # as in the paper: nothing is skipped
    for name, changes in skip_settings(iterations if isinstance(iterations, int) else config.iterations).items():
        on = request.skip.get(name, False)
        on = on and not (name == "low_resolution" and config.lpips_weight == 0)  # patches are all it saves
        chosen = {n: value if on else getattr(off, n) for n, value in changes.items()}
        config = dataclasses.replace(config, **chosen)
    known = {f.name for f in dataclasses.fields(ZipNerfConfig)}
    unknown = sorted(set(request.overrides) - known)
    if unknown:
        raise ValueError(
            f"overrides: {unknown[0]} is not a setting of the trainer; those are {', '.join(sorted(known))}."
        )
    try:
        return dataclasses.replace(config, **_values(request.overrides))
    except (ValueError, TypeError) as error:
        raise ValueError(f"overrides: {error}") from None


def _values(document: Mapping[str, Any]) -> dict[str, Any]:
    """Settings from JSON or YAML, which know lists only."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in document.items()}


def config_document(config: ZipNerfConfig) -> dict[str, Any]:
    """The settings as plain values, see YOUNGER."""
    default = ZipNerfConfig()
    document = dataclasses.asdict(config)
    return {n: v for n, v in document.items() if n not in YOUNGER or v != getattr(default, n)}


def config_from_document(document: Mapping[str, Any]) -> ZipNerfConfig:
    """Settings as `config_document` left them. Raises ValueError for those of another version."""
    try:
        return ZipNerfConfig(**_values(document))
    except TypeError as error:
        raise ValueError(str(error)) from None


def rules(skip: Mapping[str, bool]) -> dict[str, Any]:
    """The numbers that `fitted` goes by, for the switches that are on."""
    found: dict[str, Any] = {
        "rays": [PASSES, FEWEST_RAYS, GENERATED_SHARE, LEAST_PASSES] if skip.get("rays") else False
    }
    return found | ({"plateau": [FEW_VIEWS, PATIENT, GENERATED]} if skip.get("plateau") else {})


def fitted(
    config: ZipNerfConfig, views: Views, skip: Mapping[str, bool], given: Iterable[str] = ()
) -> tuple[ZipNerfConfig, list[Decision]]:
    """The settings where they depend on what there is to train on, and why; those `given` by the user stay."""
    captured = int(views.captured.sum())
    changes: dict[str, Any] = {}
    decisions = []
    if captured == len(views):  # as for the baseline: captured views agree with each other
        changes |= {"lpips_weight": 0.0, "low_resolution_iterations": 0}
    if skip.get("plateau"):
        changes |= GENERATED if captured < len(views) else {}
        changes |= PATIENT if captured > FEW_VIEWS else {}
    # The rays that left out pixels of generated views would have had go to captured ones.
    changes |= {"captured_share": max(config.captured_share, left_out(views))}
    kept = set(given)
    rays, why = enough_rays(config, int(views.counting.sum()), captured < len(views))
    if skip.get("rays") and rays < config.batch_rays and "batch_rays" not in kept:
        changes |= {"batch_rays": rays}
        text = f"{rays} instead of {config.batch_rays} rays a step: {why}."
        decisions.append(Decision("skipped", text, "rays", {"rays_a_step": config.batch_rays - rays}))
    config = dataclasses.replace(config, **{n: v for n, v in changes.items() if n not in kept})
    smallest = int(views.size.min())
    if config.patch_size > smallest:
        config = dataclasses.replace(config, patch_size=smallest)
        if config.lpips_weight > 0:
            text = f"LPIPS patches are {smallest} pixels, the shorter side of the smallest view."
            decisions.append(Decision("chosen", text))
    return config, decisions


def left_out(views: Views) -> float:
    """Share of the pixels of generated views that do not count; 0 without generated views."""
    pixels = views.size.prod(-1)
    generated = ~views.captured
    if not bool(generated.any()):
        return 0.0
    return float((pixels - views.counting)[generated].sum() / pixels[generated].sum())


def enough_rays(config: ZipNerfConfig, pixels: int, generated: bool) -> tuple[int, str]:
    """Rays of a step that are enough for so many pixels, some of them generated or none, and why."""
    most = config.batch_rays
    if generated and config.iterations * GENERATED_SHARE * most >= LEAST_PASSES * pixels:
        most = round(GENERATED_SHARE * most)
    few = max(FEWEST_RAYS, pixels // PASSES)
    if few < most:
        return few, f"{PASSES} steps see as many as all pixels"
    return most, "most pixels are generated"
