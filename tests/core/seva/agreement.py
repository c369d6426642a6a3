"""How far our SEVA is from the numbers of the original: the table of docs/explanation/seva.md.

python -m tests.core.seva.agreement FOLDER_OF_FIXTURES
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.diffusion import SamplerConfig
from cat3d_core.metrics.clip import normalized
from cat3d_core.seva.cameras import rays, scene_middle, scene_scale
from cat3d_core.seva.guidance import ViewGuidance
from cat3d_core.seva.image_prompt import squashed
from cat3d_core.seva.network import resized
from cat3d_core.seva.sampler import Windows, denoised, sample
from cat3d_core.seva.schedule import SevaSchedule
from tests.core.seva.models import fixture_network, normalised_cameras

CLIP_ROWS = [0, 55, 111, 223]


def largest(got: Tensor, expected: Tensor) -> float:
    return float((got.double() - expected.double()).abs().max())


def relative(got: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest value: random weights make large numbers."""
    return largest(got, expected) / float(expected.abs().max())


def network_rows(folder: Path) -> list[tuple[str, str, float]]:
    network, f = fixture_network(folder)
    x, time, dense, uneven = f["in.x"], f["in.t"], f["in.dense"], f["in.context_uneven"]
    single, joint = network.down_blocks[0].attentions[0], network.up_blocks[2].attentions[0]
    block, features = network.down_blocks[1].resnets[0], f["sub.resblock.in"]
    pairs = {
        "network, two windows of five views": (network.folded(x, time, dense, f["in.context"], 5), "out.eps"),
        "network, another context in each row": (network.folded(x, time, dense, uneven, 5), "out.eps_uneven"),
        "network, views alone": (
            network.folded(x[:2], time[[0, 5]], dense[:2], f["in.context"][[0, 5]], 1), "out.eps_views1",
        ),
        "residual block": (
            block(features, F.silu(f["sub.resblock.emb"]), resized(dense, features)), "sub.resblock.out",
        ),
        "transformer on single views": (single(f["sub.transformer2d.in"], 5, uneven), "sub.transformer2d.out"),
        "transformer on all views": (joint(f["sub.transformer3d.in"], 5, uneven), "sub.transformer3d.out"),
    }  # fmt: skip
    return [(what, "1e-4", largest(got, f[name])) for what, (got, name) in pairs.items()]


def camera_rows(f: dict[str, Tensor]) -> list[tuple[str, str, float]]:
    shifted = f["cam.c2w_opencv"][:, :3, 3] - scene_middle(f["cam.all_c2w"][:, :3, 3])
    own, k = f["cam.c2w_opencv"], f["cam.K_normalised"]
    scene = normalised_cameras(f["cam.all_c2w"], k[:1].expand(8, 3, 3))
    placed = scene_scale(scene).cameras(normalised_cameras(own, k)).world_from_camera
    expected = f["cam.c2w_scaled"]
    return [
        ("scaled camera centres", "equal", largest(shifted * (2 / shifted[0].norm()), expected[:, :3, 3])),
        ("the same as one similarity", "3e-7", largest(placed, expected)),
        ("Plücker rays", "1e-6", largest(rays(normalised_cameras(expected, k), 16, 24), f["cam.plucker"])),
    ]


def guidance_rows(f: dict[str, Tensor]) -> list[tuple[str, str, float]]:
    cameras = normalised_cameras(f["guide.c2w"], f["guide.K"])
    without, with_ = f["guide.pred"].chunk(2)
    out = []
    names = {"uniform": "vanilla_s3", "multiview": "multiview_s3_min1.2", "temporal": "temporal_s3_min1.2"}
    for guider, name in names.items():
        scales = ViewGuidance(guider, 3.0, 1.2).scales(cameras, f["guide.input_mask"])  # type: ignore[arg-type]
        guided = without + scales[:, None, None, None] * (with_ - without)
        out.append((f"guidance, {guider}", "1e-5", largest(guided, f[f"guide.{name}"])))
    return out


def sampling_rows(folder: Path, f: dict[str, Tensor]) -> list[tuple[str, str, float]]:
    from tests.core.seva.test_sampler import Linear

    schedule, network = SevaSchedule(), fixture_network(folder)[0]
    levels = largest(torch.exp(-schedule.log_snr / 2).float(), f["sigmas.n1000_ascending"])
    for steps in (50, 20, 4, 1):
        nodes = torch.exp(-schedule.nodes("trailing", steps) / 2).float()
        levels = max(levels, largest(nodes, f[f"sigmas.n{steps}_with_zero"][:-1]))
    cameras = normalised_cameras(f["cam.c2w_scaled"], f["cam.K_normalised"])
    latents, mask = f["traj.replace"].split([4, 1], 1)
    given = mask[:, 0, 0, 0] > 0

    def window(scales: Tensor) -> Windows:
        parts = latents, given, rays(cameras, 16, 24), f["traj.context"], scales
        return Windows(*(part[None] for part in parts))

    level = schedule.log_snr[schedule.time(-2 * f["den.sigma"][:1].double().log())]
    x = float(torch.sigmoid(level).sqrt()) * f["den.x"][None]
    clean = denoised(network, window(torch.ones(5)), x, float(level))[0]
    out = [
        ("noise levels: the table, and 50, 20, 4, 1 steps", "equal", levels),
        ("denoiser, relative", "1e-3", relative(clean, f["den.denoised"])),
    ]
    for name, guidance in (("tiny_4steps_cfg2_multiview", ViewGuidance("multiview", 2.0)),
                           ("tiny_4steps_cfg3_temporal", ViewGuidance("temporal", 3.0)),
                           ("toy_4steps_cfg2", ViewGuidance("multiview", 2.0))):  # fmt: skip
        used = Linear() if "toy" in name else network
        steps = SamplerConfig("ddim", "trailing", 4)
        got = sample(used, window(guidance.scales(cameras, given)), f["traj.noise"][None], steps)  # type: ignore[arg-type]
        what = "a linear network" if "toy" in name else f"the network, {guidance.guider} guidance"
        out.append((f"four steps of {what}, relative", "1e-3", relative(got[0], f[f"traj.{name}"])))
    return out


def clip_rows(f: dict[str, Tensor]) -> list[tuple[str, str, float]]:
    squeezed = squashed((f["clip.image"].float() + 1) / 2, 224)
    both = {"resized": 2 * squeezed - 1, "normalised": normalized(squeezed)}
    return [
        (f"image for CLIP, {name}", "1e-5", largest(image[:, :, CLIP_ROWS], f[f"clip.{name}_rows_0_55_111_223"]))
        for name, image in both.items()
    ]


def main() -> None:
    folder = Path(sys.argv[1])
    f = load_file(folder / "seva_sampling.safetensors")
    rows = [*network_rows(folder), *sampling_rows(folder, f), *camera_rows(f), *guidance_rows(f), *clip_rows(f)]
    print("| what | may differ by | differs by |\n|---|---|---|")
    for what, limit, found in rows:
        print(f"| {what} | {limit} | {f'{found:.1e}' if found else '0'} |")


if __name__ == "__main__":
    with torch.no_grad():
        main()
