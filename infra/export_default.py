"""Ship a trained model: weights in float16 to cat3d_core/weights/, its numbers to the model card.

    cat3d train default --out WORK --set bank.textures=PHOTOS   # hours on two CPU cores, minutes on a GPU; resumable
    python infra/export_default.py WORK --scenes 20             # 20 held-out scenes of each family

`--scenes 0` leaves the evaluation out. Start the next training from the shipped weights: `--set start=FILE`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from cat3d_core.diffusion import describe, load_model, save_model
from flows.bench.model import evaluate_file

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS, CARD = ROOT / "cat3d_core" / "weights" / "default.safetensors", ROOT / "docs" / "model_card.md"
START, END = "<!-- numbers: written by infra/export_default.py -->", "<!-- end of numbers -->"
# What a briefly trained model is at its best with (docs/model_card.md); runs take it from the file.
SAMPLER = {"solver": "ddim", "nodes": "trailing", "steps": 4, "guidance": 1.0}


def export(model: Path, scenes: int, pictures: Path, data: Path | None) -> None:
    """`model` in float16 as the shipped one; evaluated on `scenes` held-out scenes a family (0: not), and on the
    captured scenes in `data`."""
    provenance = describe(model)["provenance"] | {"sampler": SAMPLER}
    digest = save_model(WEIGHTS, load_model(model), provenance, torch.float16)
    WEIGHTS.chmod(0o644)
    tables = evaluate_file(WEIGHTS, scenes, pictures=pictures, data=data) if scenes else "Not evaluated yet."
    facts = (
        f"Exported {time.strftime('%Y-%m-%d %H:%M')}; this training: {provenance['groups_of_views']:,} groups of views "
        f"in {provenance['steps']:,} steps, {provenance['hours']} hours; file {WEIGHTS.stat().st_size / 1e6:.1f} MB; "
        f"SHA-256 of the weights `{digest}`."
    )
    head, _, rest = CARD.read_text().partition(START)
    CARD.write_text(f"{head}{START}\n{facts}\n\n{tables}\n{END}{rest.partition(END)[2]}")
    print(facts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="the folder of a finished (or running) `cat3d train`")
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes of each family")
    parser.add_argument("--data", type=Path, help="folder with captured scenes to evaluate on too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    export(options.work / "model.safetensors", options.scenes, options.work / "pictures", options.data)


if __name__ == "__main__":
    main()
