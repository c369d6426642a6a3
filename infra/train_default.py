"""Train the default model from nothing but procedural scenes and a folder of free photographs.

    python infra/train_default.py photos WORK --folder PHOTOS      # squares of them -> WORK/photos.safetensors
    python infra/train_default.py render WORK --scenes 3500        # shards of rendered scenes  -> WORK/renders/
    python infra/train_default.py autoencoder WORK --minutes 15    # -> WORK/autoencoder.safetensors
    python infra/train_default.py encode WORK                      # latents of all shards      -> WORK/latents/
    python infra/train_default.py train WORK --until 05:25         # -> WORK/state.safetensors, WORK/model.safetensors
    python infra/train_default.py export WORK --scenes 20          # -> cat3d_core/weights/, numbers on the model card

Every step continues where it was stopped. `--device cuda` runs the same on a GPU, in legs of `--minutes`. Needs torch,
numpy and safetensors; `photos` and `export` need the rest of the package.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import (
    SIZES,
    Autoencoder,
    LatentBank,
    ModelConfig,
    MultiViewModel,
    TrainConfig,
    Trainer,
    autoencoder_loss,
    describe,
    load_model,
    load_state,
    save_model,
    save_state,
)
from cat3d_core.random import derive_seed, generator
from cat3d_core.synthetic import FAMILIES
from cat3d_core.synthetic.dataset import Capture, mirrored, recoloured, training_capture

# Fourier features of the rays: in a short training they make up for much of what a long one would learn.
DEFAULT = replace(SIZES["small"], unet=replace(SIZES["small"].unet, ray_octaves=3))
HELD_OUT_PHOTOS = 6
VIEWS = 16
SHARD_SCENES = 25
START, END = "<!-- numbers: written by infra/train_default.py export -->", "<!-- end of numbers -->"


def log(work: Path, **record: object) -> None:
    """One JSON line to WORK/log and to the terminal."""
    line = json.dumps({"time": time.strftime("%H:%M:%S"), **record})
    print(line, flush=True)
    with (work / "log").open("a") as file:
        file.write(line + "\n")


def save(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write under the final name only when complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({k: t.contiguous() for k, t in tensors.items()}, partial)
    partial.replace(path)


def photos(work: Path, folder: Path, side: int = 448) -> None:
    """Centre squares of all photographs, in the order of names; the last HELD_OUT_PHOTOS are never trained on."""
    from flows.images import read_image  # OpenImageIO: not on a bare GPU machine

    squares = []
    for path in sorted(folder.glob("*.jpg")):
        image = torch.from_numpy(read_image(path)[0][..., :3].copy()).permute(2, 0, 1)[None].float()
        height, width = image.shape[-2:]
        cut = min(height, width)
        top, left = (height - cut) // 2, (width - cut) // 2
        image = image[..., top : top + cut, left : left + cut]
        squares.append(F.interpolate(image, (side, side), mode="bilinear", antialias=True).round().clamp(0, 255))
    if not squares:
        raise ValueError(f"There are no .jpg photographs in {folder}; give the folder of the photo pool.")
    order = torch.randperm(len(squares), generator=generator(0, "photo order"))
    save(work / "photos.safetensors", {"photos": torch.cat(squares)[order].to(torch.uint8)})


def training_photos(work: Path) -> Tensor:
    return load_file(work / "photos.safetensors")["photos"][:-HELD_OUT_PHOTOS].float() / 255


def render(work: Path, scenes: int, size: int, rank: int, ranks: int, device: str) -> None:
    """Shards of SHARD_SCENES scenes, families in turn. Shard n holds scenes n * SHARD_SCENES onwards."""
    textures = training_photos(work)
    for shard in range(rank, -(-scenes // SHARD_SCENES), ranks):
        path = work / "renders" / f"{shard:05d}.safetensors"
        if path.exists():
            continue
        start, parts = time.time(), []
        numbers = range(shard * SHARD_SCENES, (shard + 1) * SHARD_SCENES)
        for number in numbers:
            for attempt in range(10):
                try:
                    seed = derive_seed(1, "training scene", number, attempt) & 0x7FFFFFFF
                    family = FAMILIES[number % len(FAMILIES)]
                    parts.append(as_tensors(training_capture(family, seed, VIEWS, size, textures, device)))
                    break
                except ValueError:  # no free place for the cameras: the next seed
                    continue
        stacked = {name: torch.stack([p[name] for p in parts]) for name in parts[0]}
        stacked["family"] = torch.tensor([number % len(FAMILIES) for number in numbers])
        save(path, stacked)
        log(work, step="render", shard=shard, seconds=round(time.time() - start, 1))


def shards(work: Path, kind: str) -> list[Path]:
    return sorted((work / kind).glob("*.safetensors"))


def photo_crops(pictures: Tensor, count: int, size: int, random: torch.Generator) -> Tensor:
    """(count, 3, size, size) random windows of photographs (M, 3, H, W), at random scales, resampled."""
    crops = []
    for _ in range(count):
        pick = int(torch.randint(len(pictures), (), generator=random))
        share, fy, fx, flip = torch.rand(4, generator=random).tolist()
        full = pictures.shape[-1]
        side = int(size + (full - size) * share**1.2)
        top, left = int(fy * (full - side)), int(fx * (full - side))
        window = pictures[pick : pick + 1, :, top : top + side, left : left + side]
        crop = F.interpolate(window, (size, size), mode="bilinear", antialias=True, align_corners=False)
        crops.append(crop.flip(-1) if flip < 0.5 else crop)
    return torch.cat(crops).clamp(0, 1)


def autoencoder_batch(pictures: Tensor, renders: Tensor, count: int, size: int, random: torch.Generator) -> Tensor:
    """Half photographs, half renders (uint8), float in [0, 1]."""
    pick = torch.randint(len(renders), (count // 2,), generator=random)
    return torch.cat([photo_crops(pictures, count - count // 2, size, random), renders[pick].float() / 255])


@torch.no_grad()
def reconstruction_psnr(autoencoder: Autoencoder, images: Tensor) -> float:
    """Mean PSNR in dB over images (B, 3, H, W)."""
    dtype = next(autoencoder.parameters()).dtype
    decoded = autoencoder.decode(autoencoder.encode(images.to(dtype)).float())
    return float((-10 * (decoded - images).square().mean((1, 2, 3)).log10()).mean())


def train_autoencoder(work: Path, config: ModelConfig, minutes: float, device: str) -> None:
    """Continue for `minutes`; the learning rate falls to its end over that time."""
    size, batch, peak = config.image_size, 16, 2.5e-3
    everything = load_file(work / "photos.safetensors")["photos"].float() / 255
    held_out = photo_crops(everything[-HELD_OUT_PHOTOS:], 64, size, generator(9, "held-out crops"))
    pictures = everything[:-HELD_OUT_PHOTOS]
    renders = torch.cat([load_file(p)["image"].flatten(0, 1) for p in shards(work, "renders")[:24]])
    model = Autoencoder(config.autoencoder).to(device).to(memory_format=torch.channels_last)
    path = work / "autoencoder.safetensors"
    if path.exists():
        model.load_state_dict(load_file(path))
    optimizer = torch.optim.AdamW(model.parameters(), lr=peak, betas=(0.9, 0.99), weight_decay=1e-3)
    start, step, random = time.time(), 0, generator(int(time.time()), "autoencoder")
    while (passed := (time.time() - start) / 60 / minutes) < 1:
        rate = peak * min(1.0, (step + 1) / 60) * (1 - passed) ** 0.8
        optimizer.param_groups[0]["lr"] = rate
        images = autoencoder_batch(pictures, renders, batch, size, random).to(device)
        with torch.autocast(device, torch.bfloat16):
            shape = (batch, config.autoencoder.latent_channels, size // 8, size // 8)
            loss, record = autoencoder_loss(model, images, torch.randn(shape, device=device))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        step += 1
        if step % 200 == 0:
            test = reconstruction_psnr(model, held_out.to(device))
            log(work, step="autoencoder", n=step, lr=round(rate, 6), held_out_psnr=round(test, 2), **rounded(record))
    model.calibrate(autoencoder_batch(pictures, renders, 1024, size, random).to(device))
    save(path, {k: t.cpu() for k, t in model.state_dict().items()})
    photo, scene = reconstruction_psnr(model, held_out.to(device)), reconstruction_psnr(model, renders[-256:] / 255.0)
    log(work, step="autoencoder done", n=step, held_out_psnr=round(photo, 2), renders_psnr=round(scene, 2))


def rounded(record: dict[str, float]) -> dict[str, float]:
    return {k: float(f"{v:.4g}") for k, v in record.items()}


def as_tensors(capture: Capture) -> dict[str, Tensor]:
    return {
        "image": (capture.image * 255).round().to(torch.uint8),
        "intrinsics": capture.cameras.intrinsics.float(),
        "world_from_camera": capture.cameras.world_from_camera.float(),
    }


def variants(shard: dict[str, Tensor], scene: int, name: str) -> list[Capture]:
    """Scene number `scene` of a shard as rendered, recoloured and mirrored, and recoloured."""
    image, k, pose = (shard[key][scene] for key in ("image", "intrinsics", "world_from_camera"))
    size = torch.tensor([image.shape[-1], image.shape[-2]]).repeat(len(image), 1)
    capture = Capture(image.float() / 255, Cameras(k, pose, size))
    random = generator(scene, "variant", name)
    return [capture, mirrored(recoloured(capture, random)), recoloured(capture, random)]


@torch.no_grad()
def encode(work: Path, config: ModelConfig, device: str) -> None:
    """Latents of every rendered shard that has none yet, in three variants of each scene."""
    autoencoder = Autoencoder(config.autoencoder)
    autoencoder.load_state_dict(load_file(work / "autoencoder.safetensors"))
    autoencoder = autoencoder.to(device).eval()
    for path in shards(work, "renders"):
        target = work / "latents" / path.name
        if target.exists():
            continue
        shard, parts, family = load_file(path), [], []
        for scene in range(len(shard["family"])):
            for capture in variants(shard, scene, path.name):
                latents = autoencoder.encode(capture.image.to(device)).cpu().half()
                parts.append({"latents": latents, **{k: t for k, t in as_tensors(capture).items() if k != "image"}})
                family.append(shard["family"][scene])
        save(
            target, {name: torch.stack([p[name] for p in parts]) for name in parts[0]} | {"family": torch.stack(family)}
        )
    log(work, step="encode", shards=len(shards(work, "latents")))


def load_bank(work: Path, config: ModelConfig) -> LatentBank:
    parts = [load_file(path) for path in shards(work, "latents")]
    joined = {name: torch.cat([p[name] for p in parts]) for name in parts[0]}
    return LatentBank(**joined, image_size=config.image_size)


def jitter_scale(raymaps: Tensor, random: torch.Generator) -> Tensor:
    """Scale each group's ray origins by 0.7 to 1.4: in use the unit of a scene is only known about."""
    factor = 0.7 * 2 ** torch.rand(len(raymaps), 1, 1, 1, 1, generator=random)
    return torch.cat([raymaps[:, :, :3] * factor, raymaps[:, :, 3:]], 2)


def progress_of(start: float, end: float) -> float:
    return min(max((time.time() - start) / max(end - start, 1.0), 0.0), 1.0)


def train(work: Path, config: ModelConfig, until: float, groups: int, peak: float, device: str, seed: int = 0) -> None:
    """Train to the clock: learning rate and camera spread follow the time passed of the whole run (start kept in
    WORK/clock.json), because on a borrowed machine time, not steps, is what is given."""
    model = new_model(work, config)
    settings = TrainConfig(learning_rate=peak, final_learning_rate=peak, warmup_steps=150, ema_decay=0.998)
    trainer = Trainer(settings, model, seed, device)
    state_path, clock_path = work / "state.safetensors", work / "clock.json"
    if state_path.exists():
        trainer.load_state(load_state(state_path)[0])
    clock = json.loads(clock_path.read_text()) if clock_path.exists() else {"start": time.time(), "groups": 0}
    seen, last_save, last_log, losses = clock["groups"], time.time(), time.time(), []
    bank, bank_shards = load_bank(work, config), len(shards(work, "latents"))
    while time.time() < until:
        passed = progress_of(clock["start"], until)
        set_learning_rate(trainer, peak * max(1 - passed, 0.0) ** 0.8 + 1e-5)
        spread = min(1.0, 0.5 + 0.7 * passed)
        latents, raymaps = bank.batch(groups, config.views, seed, trainer.calls, spread=spread)
        random = generator(seed, "jitter", trainer.calls)
        record = trainer.step(latents, jitter_scale(raymaps, random), 3 if trainer.calls % 2 else 1)
        seen += groups
        losses.append(record["loss"])
        if time.time() - last_log > 60:
            rate = trainer.config.learning_rate_at(trainer.steps)
            mean = sum(losses) / len(losses)
            log(work, step="train", n=trainer.steps, groups=seen, lr=rate, spread=round(spread, 2),
                loss=round(mean, 4), grad=round(record["grad_norm"], 3), bank=len(bank),
                groups_per_s=round(len(losses) * groups / (time.time() - last_log), 2))  # fmt: skip
            last_log, losses = time.time(), []
        if time.time() - last_save > 240 or time.time() >= until:
            save_training(work, trainer, clock | {"groups": seen, "steps": trainer.steps})
            last_save = time.time()
            if len(shards(work, "latents")) != bank_shards:
                bank, bank_shards = load_bank(work, config), len(shards(work, "latents"))
    save_training(work, trainer, clock | {"groups": seen, "steps": trainer.steps})


def set_learning_rate(trainer: Trainer, rate: float) -> None:
    """The trainer's own schedule counts steps; this one counts time, so the constant is replaced as it goes."""
    trainer.config = replace(trainer.config, learning_rate=rate, final_learning_rate=rate)


def new_model(work: Path, config: ModelConfig) -> MultiViewModel:
    torch.manual_seed(0)
    model = MultiViewModel(config)
    # From scratch there is no pretrained network to start as: let the rays in from the first step.
    torch.nn.init.kaiming_uniform_(model.unet.conv_in.weight, a=5**0.5)
    model.autoencoder.load_state_dict(load_file(work / "autoencoder.safetensors"))
    return model


def save_training(work: Path, trainer: Trainer, clock: dict) -> None:
    save_state(work / "state.safetensors", trainer.state(), clock)
    provenance = {
        "data": f"procedural scenes of cat3d_core.synthetic ({', '.join(FAMILIES)}), textures from free photographs",
        "steps": trainer.steps, "groups_of_8_views": clock["groups"],
        "hours": round((time.time() - clock["start"]) / 3600, 2),
    }  # fmt: skip
    save_model(work / "model.safetensors", trainer.ema_model(), provenance)
    (work / "clock.json").write_text(json.dumps(clock))


def export(work: Path, scenes: int) -> None:
    """Ship the averaged weights in float16, evaluate them on `scenes` held-out scenes a family (0: don't), and put the
    numbers on the model card."""
    from cat3d_core.weights import default_model_path
    from flows.bench.model import evaluate_file

    clock = json.loads((work / "clock.json").read_text())
    # What the model is at its best with at this stage of training (docs/model_card.md); runs take it from the file.
    sampler = {"solver": "ddim", "nodes": "trailing", "steps": 4, "guidance": 1.0}
    source = describe(work / "model.safetensors")["provenance"] | {"sampler": sampler}
    root = Path(__file__).resolve().parents[1]
    target = root / "cat3d_core" / "weights" / "default.safetensors"
    digest = save_model(target, load_model(work / "model.safetensors"), source, torch.float16)
    target.chmod(0o644)
    tables = evaluate_file(default_model_path(), scenes, pictures=work / "pictures") if scenes else "Not evaluated yet."
    card = root / "docs" / "model_card.md"
    head, _, rest = card.read_text().partition(START)
    facts = (
        f"Exported {time.strftime('%Y-%m-%d %H:%M')}; {clock['groups']:,} groups of 8 views seen in "
        f"{source['steps']:,} steps, {source['hours']} hours; file {target.stat().st_size / 1e6:.1f} MB; "
        f"SHA-256 of the weights `{digest}`."
    )
    card.write_text(f"{head}{START}\n{facts}\n\n{tables}\n{END}{rest.partition(END)[2]}")
    log(work, step="export", sha256=digest, **clock)


def clock_time(text: str) -> float:
    """Seconds since the epoch of the next HH:MM by this machine's clock."""
    now = time.localtime()
    hour, minute = (int(part) for part in text.split(":"))
    then = time.mktime((*now[:3], hour, minute, 0, *now[6:8], -1))
    return then if then > time.time() else then + 86400


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["photos", "render", "autoencoder", "encode", "train", "export"])
    parser.add_argument("work", type=Path, help="folder for everything that is made (outside the repository)")
    parser.add_argument("--folder", type=Path, help="photographs (photos)")
    parser.add_argument("--scenes", type=int, default=3500, help="to render, or to evaluate on per family")
    parser.add_argument("--rank", type=int, default=0)
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--until", type=clock_time, help="HH:MM (train)")
    parser.add_argument("--groups", type=int, default=4, help="groups of 8 views in a batch")
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    work, config, device = options.work, DEFAULT, options.device
    work.mkdir(parents=True, exist_ok=True)
    if options.step == "photos":
        photos(work, options.folder)
    elif options.step == "render":
        render(work, options.scenes, config.image_size, options.rank, options.ranks, device)
    elif options.step == "autoencoder":
        train_autoencoder(work, config, options.minutes, device)
    elif options.step == "encode":
        encode(work, config, device)
    elif options.step == "train":
        until = options.until or time.time() + 60 * options.minutes
        train(work, config, until, options.groups, options.learning_rate, device)
    elif options.step == "export":
        export(work, options.scenes)


if __name__ == "__main__":
    main()
