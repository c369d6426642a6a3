"""How to put sweep and sample together, fitted on scenes that neither was trained on and that no table evaluates.

The first shard of each folder of a sweep's bank is held out of its training (`bank.held`). On groups of 8 of its views,
3 or 1 given, the share sigmoid((confidence - middle) / softness) of the sweep's colour is chosen for the least mean
squared error of the composite, on average over the folders' mean errors in decibels.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.generation import Cat3dGenerator
from cat3d_core.matching.checkpoint import load_sweep
from cat3d_core.matching.composite import Composite
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.weights import default_model_path
from flows.generation.formats import cat3d
from flows.training.renders import save, shards
from flows.training.sweep_evaluation import VIEWS, Case, case, hinted_sample, sampled, swept

MIDDLES = torch.linspace(0.05, 0.75, 15).tolist()
SOFTNESSES = (0.05, 0.1, 0.15, 0.2, 0.3)


def validation_cases(folders: Sequence[Path], cache: Path, scenes: int, given: Sequence[int]) -> Iterator[Case]:
    """Groups of the held shards; the diffusion model's samples are kept in `cache`."""
    for folder in folders:
        shard = load_file(shards(folder, "renders")[0])
        for number in range(min(scenes, len(shard["family"]))):
            for m in given:
                path = cache / f"held_{folder.name}_{number:03d}_{m}.safetensors"
                if not path.exists():
                    save(path, _group(shard, number, m))
                yield case(path.stem, (folder.name,), m, load_file(path))


def _group(shard: dict[str, Tensor], number: int, given: int) -> dict[str, Tensor]:
    order = torch.randperm(shard["image"].shape[1], generator=torch.Generator().manual_seed(number))[:VIEWS]
    image = shard["image"][number, order].float() / 255
    size = torch.tensor([[image.shape[-1], image.shape[-2]]]).repeat(VIEWS, 1)
    cameras = Cameras(
        shard["intrinsics"][number, order].double(), shard["world_from_camera"][number, order].double(), size
    )
    depth = shard["inverse_depth"][number, order[given:]].float()
    return sampled(image, cameras, given, ("composite", number)) | {"inverse_depth": depth}


def fitted(
    network: SweepNetwork, found: Iterator[Case], generator: Cat3dGenerator | None = None
) -> tuple[Composite, dict[str, float]]:
    """The best composite, and mean PSNR (over folders and numbers of given views) of sweep, sample and composite.

    generator: makes the samples, if it takes hints."""
    grid = [Composite(middle, softness) for middle in MIDDLES for softness in SOFTNESSES]
    errors: dict[tuple[str, int], list[Tensor]] = {}
    for one in found:
        h, truth = swept(network, one), one.image[one.given :]
        sample = one.pictures["sample"] if generator is None else hinted_sample(generator, one, h)
        pictures = [h.colour, sample, *(c(h.colour, h.confidence, sample) for c in grid)]
        decibels = [-10 * (p - truth).square().mean((1, 2, 3)).log10().mean() for p in pictures]
        errors.setdefault((one.labels[0], one.given), []).append(torch.stack(decibels))
    mean = torch.stack([torch.stack(several).mean(0) for several in errors.values()]).mean(0)
    best = int(mean[2:].argmax())
    numbers = {"sweep": mean[0], "sample": mean[1], "composite": mean[2 + best]}
    return grid[best], {name: round(float(value), 3) for name, value in numbers.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", type=Path)
    parser.add_argument("--model", type=Path, help="the diffusion model; none: the one shipped")
    parser.add_argument("folders", type=Path, nargs="+", help="folders of a sweep's bank")
    parser.add_argument("--scenes", type=int, default=12, help="of each folder")
    parser.add_argument("--given", type=int, nargs="+", default=[3, 1])
    parser.add_argument("--cache", type=Path, default=Path("outputs/bench_sweep"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.cache.mkdir(parents=True, exist_ok=True)
    found = validation_cases(options.folders, options.cache, options.scenes, options.given)
    generator = cat3d.load(options.model or default_model_path(), "cpu", "bfloat16")
    best, psnr = fitted(load_sweep(options.network), found, generator)
    print(json.dumps({"composite": json.loads(best.to_json()), "psnr_db": psnr}))


if __name__ == "__main__":
    main()
