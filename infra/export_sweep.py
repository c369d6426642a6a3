"""Ship a trained plane sweep: weights in float16, with the composite that suits them, to cat3d_core/weights/.

    cat3d train sweep --out WORK                                       # about two hours on one CPU core; resumable
    python -m infra.export_sweep WORK --fit WORK --data "procedural scenes"

`--fit` names folders of scenes (renders/*.safetensors); the first shard of each was held out of the training, and the
composite is fitted on it (flows/training/sweep_composite.py). Without it the last file's composite stays. Evaluate with
`python -m flows.training.sweep_evaluation FILE`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from cat3d_core.matching.checkpoint import describe_sweep, load_sweep, save_sweep
from flows.training.sweep_composite import fitted, validation_cases
from infra.export_default import ROOT, without_folders

WEIGHTS = ROOT / "cat3d_core" / "weights" / "sweep.safetensors"
GIVEN = (3, 1)


def export(work: Path, to: Path, fit: Sequence[Path], scenes: int, cache: Path, data: str) -> str:
    """Write the averaged weights of a training in `work` to the file `to`; returns what was done, in a sentence."""
    source = work / "sweep.safetensors"
    network, provenance = load_sweep(source), without_folders(describe_sweep(source)["provenance"])
    composite = network.composite
    if fit:
        cache.mkdir(parents=True, exist_ok=True)
        composite, psnr = fitted(network, validation_cases(fit, cache, scenes, GIVEN))
        names = [folder.name for folder in fit]
        provenance["composite_fitted_on"] = {"folders": names, "scenes": scenes, "psnr_db": psnr}
    if data:
        provenance["data"] = data
    digest = save_sweep(to, network, provenance, composite, torch.float16)
    to.chmod(0o644)
    return (
        f"Exported {time.strftime('%Y-%m-%d %H:%M')}: {provenance['steps']:,} steps, {provenance['hours']} hours; "
        f"{composite.to_json()}; {to.stat().st_size / 1e6:.1f} MB; SHA-256 of the weights `{digest}`."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="the folder of a finished (or running) `cat3d train sweep`")
    parser.add_argument("--fit", type=Path, nargs="*", default=[], help="folders of scenes to fit the composite on")
    parser.add_argument("--scenes", type=int, default=12, help="held scenes of each of them")
    parser.add_argument("--cache", type=Path, default=Path("outputs/bench_sweep"))
    parser.add_argument("--data", default="", help="what it was trained on, in a sentence for the file")
    parser.add_argument("--to", type=Path, default=WEIGHTS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(export(options.work, options.to, options.fit, options.scenes, options.cache, options.data))


if __name__ == "__main__":
    main()
