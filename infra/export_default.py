"""Ship a trained model: weights in float16 to cat3d_core/weights/, its numbers to the model card.

    cat3d train default --out WORK --set bank.textures=PHOTOS   # hours on two CPU cores, minutes on a GPU; resumable
    python infra/export_default.py WORK --scenes 20             # 20 held-out scenes of each family

`--refine 5` first trains the decoder alone for 5 minutes with the perceptual distance that is on this machine; latents
stay what they are. `--scenes 0` leaves the evaluation out. `--to FOLDER` leaves file and card there instead. Start the
next training from the shipped weights: `--start FILE`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from cat3d_core.diffusion import MultiViewModel, describe, load_model, save_model
from cat3d_core.generation.advice import FEW_STEPS
from cat3d_core.metrics.perceptual import find_perceptual
from flows.training.autoencoder import reconstruction_psnr, train_autoencoder
from flows.training.evaluation import evaluate_file
from flows.training.prepare import read_photos
from flows.training.renders import rendered_images

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS, CARD = ROOT / "cat3d_core" / "weights" / "default.safetensors", ROOT / "docs" / "explanation" / "model_card.md"
START, END = "<!-- numbers: written by infra/export_default.py -->", "<!-- end of numbers -->"
HELD_OUT_PHOTOS = 6  # for the autoencoder's test
# What a briefly trained model is at its best with (docs/explanation/model_card.md); runs take it from the file.
SAMPLER = {name: getattr(FEW_STEPS, name) for name in ("solver", "nodes", "steps")}
SAMPLER["guidance"] = FEW_STEPS.guidance.scale


def refine(model: MultiViewModel, training: dict[str, Any], work: Path, minutes: float) -> dict[str, Any]:
    """Refine the model's decoder on the bank's renders and the photographs of its training; what was done."""
    perceptual = find_perceptual()
    if perceptual is None:
        raise SystemExit("--refine needs the weights of a perceptual distance (docs/guides/sweep.md, 'The tables').")
    bank = training["bank"]
    pictures = rendered_images(Path(bank["folder"] or work), 8192)
    photos = read_photos(Path(bank["textures"])) if bank["textures"] else None
    held_out, photos = pictures[-256:].float() / 255, None if photos is None else photos[:-HELD_OUT_PHOTOS]
    before = model.autoencoder
    model.autoencoder = train_autoencoder(
        before, pictures[:-256], photos, 60 * minutes, learning_rate=1e-3, perceptual=perceptual, decoder_only=True
    )
    scores = {}
    for name, autoencoder in (("before", before), ("after", model.autoencoder)):
        decoded = autoencoder.decode(autoencoder.encode(held_out[:64]))
        scores[name] = {"psnr": reconstruction_psnr(autoencoder, held_out),
                        perceptual.name: float(perceptual(decoded, held_out[:64]).mean())}  # fmt: skip
    return {"minutes": minutes, "perceptual": perceptual.name, "renders": scores}


def without_folders(value: Any) -> Any:
    """A document in which absolute paths, which say nothing elsewhere, are replaced by their last name."""
    if isinstance(value, dict):
        return {name: without_folders(part) for name, part in value.items()}
    if isinstance(value, list):
        return [without_folders(part) for part in value]
    return Path(value).name if isinstance(value, str) and value.startswith("/") else value


def export(
    work: Path, scenes: int, data: Path | None, refine_minutes: float, weights: Path = WEIGHTS, card: Path = CARD
) -> None:
    """The model of `work` in float16 as the shipped one; evaluated on `scenes` held-out scenes a family (0: not), and
    on the captured scenes in `data`. Files: `weights`, and the shipped card with its numbers replaced as `card`."""
    source = work / "model.safetensors"
    model, provenance = load_model(source), describe(source)["provenance"] | {"sampler": SAMPLER}
    if refine_minutes:
        provenance["decoder_refined"] = refine(model, provenance["training"], work, refine_minutes)
        print(provenance["decoder_refined"])
    provenance = without_folders(provenance)
    digest = save_model(weights, model, provenance, torch.float16)
    weights.chmod(0o644)
    tables = evaluate_file(weights, scenes, pictures=work / "pictures", data=data) if scenes else "Not evaluated yet."
    facts = (
        f"Exported {time.strftime('%Y-%m-%d %H:%M')}; this training: {provenance['groups_of_views']:,} groups of views "
        f"in {provenance['steps']:,} steps, {provenance['hours']} hours; file {weights.stat().st_size / 1e6:.1f} MB; "
        f"SHA-256 of the weights `{digest}`."
    )
    head, _, rest = CARD.read_text().partition(START)
    card.write_text(f"{head}{START}\n{facts}\n\n{tables}\n{END}{rest.partition(END)[2]}")
    print(facts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="the folder of a finished (or running) `cat3d train`")
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes of each family")
    parser.add_argument("--data", type=Path, help="folder with captured scenes to evaluate on too")
    parser.add_argument("--refine", type=float, default=0.0, help="minutes of training the decoder alone first")
    parser.add_argument("--to", type=Path, help="folder for the file and the card (default: where they are shipped)")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    files = (options.to / WEIGHTS.name, options.to / CARD.name) if options.to else (WEIGHTS, CARD)
    export(options.work, options.scenes, options.data, options.refine, *files)


if __name__ == "__main__":
    main()
