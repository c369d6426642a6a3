"""`cat3d train`: a training through the command, killed and resumed, on two ranks; presets; the 10-minute recipe."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import typing
from pathlib import Path

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion import TrainConfig, Trainer, count_parameters, describe, load_model, load_state
from cat3d_core.diffusion.pretrained import export_2d
from cat3d_core.synthetic import FAMILIES
from flows.commands.train import PRESETS, kind_of, train_command, training_config
from flows.errors import InputError
from flows.media.images import read_image
from flows.training import renders
from flows.training.autoencoder import draw_images, load_autoencoder
from flows.training.bank import jitter_scale, load_bank
from flows.training.loop import Clock, crossed, set_rate, share_done, spread_at, train_config
from flows.training.model import model_config, starting_config, starting_model
from flows.training.sheets import HeldOut, scores
from schemas.config import load_config
from schemas.errors import ConfigError
from schemas.settings import settings_document
from schemas.tables import read_rows
from schemas.training import SAMPLES, TRAINING, Family, TrainRunConfig

ROOT = Path(__file__).resolve().parents[3]
STEPS = 8
TINY = f"""
name: tiny
model: {{size: tiny, image_size: 32, unet: {{max_3d_size: 8, ray_octaves: 1}}}}
bank: {{families: [dtu, llff], scenes: 4, views: 8, variants: 2}}
autoencoder: {{minutes: 0.02, shipped: false, batch: 4}}
optimizer: {{learning_rate: 1.0e-3, final_learning_rate: 1.0e-4, warmup_steps: 2, groups: 2, accumulate: 2}}
steps: {STEPS}
log_steps: 2
save_minutes: 0.00001
sample_minutes: 60
sample_steps: 3
"""


def run(*arguments: str | Path, launcher: tuple[str, ...] = ("-m",)) -> str:
    """The command in a process of its own; returns what it printed."""
    done = subprocess.run(command(*arguments, launcher=launcher), cwd=ROOT, env=environment(), capture_output=True,
                          text=True, timeout=1200)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def command(*arguments: str | Path, launcher: tuple[str, ...] = ("-m",)) -> list[str]:
    return [sys.executable, *launcher, "flows.cli", "train", *map(str, arguments)]


def environment() -> dict[str, str]:
    return os.environ | {"COLUMNS": "200", "OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="module")
def trained(config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished training; its bank is used by the others."""
    out = tmp_path_factory.mktemp("trained")
    run(config, "--out", out, "--set", f"bank.folder={out / 'bank'}")
    return out


def test_a_training_leaves_model_tables_and_sheet(trained: Path) -> None:
    facts = describe(trained / "model.safetensors")
    assert facts["provenance"]["steps"] == STEPS
    assert facts["provenance"]["groups_of_views"] == STEPS * 4
    assert facts["provenance"]["training"]["name"] == "tiny"
    assert "dtu, llff" in facts["provenance"]["data"]
    model = load_model(trained / "model.safetensors")
    assert model.config.image_size == 32
    kept = load_autoencoder(trained / "bank" / "autoencoder.safetensors")
    assert all(torch.equal(t, model.autoencoder.state_dict()[n]) for n, t in kept.state_dict().items())
    rows = read_rows(trained / "training", TRAINING).to_pylist()
    assert [row["step"] for row in rows] == [2, 4, 6, 8]
    assert all(row["groups"] == 4 * row["step"] and row["groups_per_s"] > 0 and row["loss"] > 0 for row in rows)
    assert rows[0]["learning_rate"] > rows[-1]["learning_rate"] > 0.9e-4
    samples = read_rows(trained / "samples", SAMPLES).to_pylist()
    assert [(s["step"], s["family"], s["condition_views"]) for s in samples] == [(STEPS, "dtu", 3), (STEPS, "llff", 3)]
    sheet = read_image(trained / "samples" / f"step_{STEPS:08d}.png")[0]
    assert sheet.shape == (2 * (2 * 96 + 8), 8 * 96 + 8, 3)


def test_the_bank_holds_normalised_latents_of_every_family(trained: Path) -> None:
    bank = load_bank(trained / "bank", 32)
    assert bank.latents.shape == (8, 8, 8, 4, 4)
    assert bank.latents.dtype == torch.float16
    assert bank.family.bincount().tolist() == [4, 4]
    # A hardly trained encoder, calibrated: per channel about zero mean and unit variance, posterior noise included.
    assert bank.latents.float().mean((0, 1, 3, 4)).abs().max() < 0.5
    assert bank.latents.float().std((0, 1, 3, 4)).max() < 1.3


def test_a_finished_training_is_not_done_again(trained: Path, config: Path) -> None:
    before = (trained / "state.safetensors").stat().st_mtime_ns
    train_command(str(config), trained, {}, [f"bank.folder={trained / 'bank'}"], False)
    assert (trained / "state.safetensors").stat().st_mtime_ns == before


def test_killed_and_resumed_equals_uninterrupted_to_the_bit(trained: Path, config: Path, tmp_path: Path) -> None:
    arguments = (config, "--out", tmp_path, "--set", f"bank.folder={trained / 'bank'}")
    torch.set_num_threads(1)  # as the process that is killed
    state = tmp_path / "state.safetensors"
    started = subprocess.Popen(command(*arguments), cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not state.exists() and time.monotonic() < deadline and started.poll() is None:
        time.sleep(0.005)
    started.send_signal(signal.SIGKILL)
    started.wait()
    assert 1 <= int(load_state(state)[0]["calls"]) // 2 < STEPS
    train_command(str(config), tmp_path, {}, [arguments[-1]], False)
    once, straight = load_state(state)[0], load_state(trained / "state.safetensors")[0]
    assert set(once) == set(straight)
    assert all(torch.equal(once[name], straight[name]) for name in once)
    assert read_rows(tmp_path / "training", TRAINING)["step"].to_pylist() == [2, 4, 6, 8]


@pytest.mark.slow
def test_two_ranks_under_torchrun_share_a_training(trained: Path, config: Path, tmp_path: Path) -> None:
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
    arguments = (config, "--out", tmp_path, "--set", "bank.scenes=26", "--set", "bank.views=8", "--steps", "2")
    said = run(*arguments, launcher=torchrun)
    assert said.count("2 x cpu") == 1  # one of them speaks
    rows = read_rows(tmp_path / "training", TRAINING).to_pylist()
    assert [(row["step"], row["groups"], row["ranks"]) for row in rows] == [(2, 16, 2)]
    assert [p.name for p in renders.shards(tmp_path, "latents")] == ["00000.safetensors", "00001.safetensors"]
    assert describe(tmp_path / "model.safetensors")["provenance"]["ranks"] == 2


def test_weights_to_start_from(trained: Path) -> None:
    model = load_model(trained / "model.safetensors")
    again = starting_model(model.config, model.autoencoder, trained / "model.safetensors", 0)
    assert all(torch.equal(t, again.unet.state_dict()[n]) for n, t in model.unet.state_dict().items())
    # Convolutions and attention are of any size.
    larger = model_config("tiny", model.config.image_size * 2, unet={"ray_octaves": 1})
    assert starting_config(larger, trained / "model.safetensors") == larger
    starting_model(larger, model.autoencoder, trained / "model.safetensors", 0)
    other = model_config("tiny", 32, unet={"ray_octaves": 2})
    with pytest.raises(ValueError, match="ray_octaves is 1 there and 2 here"):
        starting_config(other, trained / "model.safetensors")


def test_a_text_to_image_network_to_start_from(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    source = model_config("tiny", unet={"channels": [64, 64], "norm_groups": 32, "camera": "vector"})
    flat = starting_model(source, load_free_autoencoder(), None, 0).unet
    state = {n: t.contiguous() for n, t in export_2d(flat).items() if "camera_embedding" not in n}
    save_file(state, tmp_path / "diffusion_pytorch_model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps({"attention_head_dim": [1, 2]}))
    asked = model_config("tiny", unet={"channels": [64, 64], "norm_groups": 32, "ray_octaves": 1})
    config = starting_config(asked, tmp_path)
    assert config.unet.channels == (64, 64)
    assert config.unet.ray_octaves == 1
    model = starting_model(config, load_free_autoencoder(), tmp_path, 0)
    assert torch.equal(model.unet.conv_in.weight[:, :8], flat.conv_in.weight[:, :8])
    assert not model.unet.conv_in.weight[:, 8:].any()  # rays and mask come in as training finds use for them


def load_free_autoencoder() -> torch.nn.Module:
    from cat3d_core.diffusion import SIZES, Autoencoder

    return Autoencoder(SIZES["tiny"].autoencoder)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["optimiser.groups=2"], "optimiser is not a setting; the settings here are name"),
        (["bank.families=[dtu, car]"], "bank.families.1 is 'car', but input should be 'llff'"),
        (["minutes=3", "steps=3"], "give one of the two"),
        (["conditions=[1, 8]"], "leaves no target in a group of 8 views"),
        (["bank.views=5"], "has 5 views, fewer than the 8 of a group"),
        (["model.image_size=60"], "multiple of 8"),
        (["model.unet={widths: [1]}"], "UNetConfig has no field widths"),
        (["model.unet={channels: [33, 64]}"], "33 channels can't be split"),
        (["model.schedule={prediction: eps}"], "eps-prediction can't be used with zero terminal SNR"),
        (["bank.scenes=9000000"], "The bank would take .* GiB, more than bank.max_gib = 8 allows"),
        (["bank.textures=/nowhere"], "there are no .jpg photographs in /nowhere"),
        (["autoencoder.path=/nowhere.safetensors"], "There is no model file /nowhere.safetensors"),
        (["start=/nowhere"], "There is no weights file or folder /nowhere"),
    ],
)
def test_a_bad_configuration_is_refused_in_a_sentence(
    settings: list[str], sentence: str, config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(renders, "render_shards", lambda folder, *_: (folder / "renders").mkdir(exist_ok=True))
    with pytest.raises((ConfigError, InputError), match=sentence):
        train_command(str(config), tmp_path, {}, settings, False)


def test_a_folder_of_another_training_is_refused(trained: Path, config: Path, tmp_path: Path) -> None:
    bank = f"bank.folder={trained / 'bank'}"
    with pytest.raises(ConfigError, match="other settings .optimizer"):
        train_command(str(config), trained, {}, [bank, "optimizer.groups=4"], False)
    with pytest.raises(ConfigError, match="bank.json belongs to a training with other settings .bank"):
        train_command(str(config), tmp_path, {}, [bank, "bank.scenes=6"], False)


def test_trainings_of_other_seeds_share_a_bank_whose_seed_is_given(trained: Path, config: Path, tmp_path: Path) -> None:
    bank, state = f"bank.folder={trained / 'bank'}", (trained / "bank" / "bank.json").read_text()
    with pytest.raises(ConfigError, match="bank.json belongs to a training with other settings .seed"):
        train_command(str(config), tmp_path, {"steps": 1, "seed": 3}, [bank], False)
    train_command(str(config), tmp_path, {"steps": 1, "seed": 3}, [bank, "bank.seed=0"], False)
    assert (trained / "bank" / "bank.json").read_text() == state


def test_a_folder_is_bound_only_by_what_is_in_it(trained: Path, config: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="There is no model file"):
        train_command(
            str(config), tmp_path, {"autoencoder": {"path": "/nowhere.safetensors"}}, ["bank.scenes=2"], False
        )
    good = {"steps": 1, "autoencoder": {"path": str(trained / "bank" / "autoencoder.safetensors")}}
    train_command(str(config), tmp_path, good, ["bank.scenes=2"], False)
    assert describe(tmp_path / "model.safetensors")["provenance"]["steps"] == 1


def test_neither_file_nor_preset() -> None:
    with pytest.raises(InputError, match="shipped are ablation_3.1, .*recipe_10_minutes"):
        training_config("nonsense", {}, [])


def test_options_win_over_settings_and_one_end_replaces_the_other() -> None:
    config = training_config("recipe_10_minutes", {"steps": 7, "seed": None}, ["optimizer.groups=9", "seed=4"])
    assert (config.steps, config.minutes, config.seed, config.optimizer.groups) == (7, None, 4, 9)
    assert training_config("ablation_temporal", {"minutes": 2.0}, []).steps is None


@pytest.mark.parametrize(
    "preset", [p for p in sorted(PRESETS.glob("*.yaml")) if kind_of(p) is TrainRunConfig], ids=lambda p: p.stem
)
def test_presets_are_sound(preset: Path) -> None:
    config = load_config(preset, TrainRunConfig)
    assert config.name == preset.stem
    assert config.note
    network = model_config(**config.model.model_dump())
    needed = renders.bank_bytes(config.bank.scenes, config.bank.views, network.image_size, config.bank.variants, 8)
    assert needed < config.bank.max_gib * 2**30
    if preset.stem == "paper":
        assert network.image_size == 512
        assert abs(count_parameters(network.unet) / 850e6 - 1) < 0.05


def test_ablations_differ_from_their_reference_in_the_model_alone() -> None:
    reference = load_config(PRESETS / "ablation_reference.yaml", TrainRunConfig)
    for path in PRESETS.glob("ablation_*.yaml"):
        config = load_config(path, TrainRunConfig)
        assert config.model_copy(update={"name": "", "note": "", "model": None}) == reference.model_copy(
            update={"name": "", "note": "", "model": None}
        )


def test_families_are_those_of_the_core() -> None:
    assert typing.get_args(Family) == FAMILIES


def test_rate_and_spread_follow_the_share_done() -> None:
    config = training_config("default", {"steps": 1000}, [])
    assert share_done(config, 250, Clock(1e9)) == 0.25
    assert share_done(training_config("default", {"minutes": 2.0}, []), 250, Clock(30.0)) == 0.25
    model = load_free_model()
    trainer = Trainer(train_config(config), model, 0)
    rates = []
    for done in (0.0, 0.5, 1.0):
        set_rate(trainer, config, done)
        rates.append(trainer.config.learning_rate_at(10_000))
    torch.testing.assert_close(torch.tensor(rates), torch.tensor([5e-4, (5e-4 + 1e-5) / 2, 1e-5]))
    assert trainer.config.learning_rate_at(0) < 2e-5  # warm-up
    assert spread_at(config, 0.35) == pytest.approx(0.75)
    assert spread_at(config, 0.9) == 1.0
    assert crossed(59, 61, 60)
    assert not crossed(61, 119, 60)


def load_free_model() -> torch.nn.Module:
    return starting_model(model_config("tiny"), load_free_autoencoder(), None, 0)


def test_defaults_are_the_paper_s() -> None:
    config = train_config(TrainRunConfig(steps=1))
    assert (config.learning_rate, config.drop_probability, config.drop) == (5e-5, 0.1, TrainConfig().drop)
    assert TrainRunConfig(steps=1).conditions == (1, 3)


def test_photographs_are_half_of_the_autoencoder_s_images() -> None:
    photos = renders.squares([torch.full((3, 40, 60), 255, dtype=torch.uint8)], side=32)
    images = draw_images(torch.zeros(5, 3, 16, 16, dtype=torch.uint8), photos, 6, torch.Generator().manual_seed(0))
    assert images.mean((1, 2, 3)).tolist() == [1, 1, 1, 0, 0, 0]
    assert draw_images(torch.zeros(5, 3, 16, 16, dtype=torch.uint8), None, 6, torch.Generator()).sum() == 0


def test_jitter_scales_positions_and_keeps_directions() -> None:
    cameras = torch.rand(6, 8, 4, 4, dtype=torch.float64) + 0.1
    hints = torch.rand(6, 5, 12, 2, 2) + 0.1
    out, told = jitter_scale(cameras, 1.5, torch.Generator().manual_seed(0), hints)
    factor = out[:, :, :3, 3:] / cameras[:, :, :3, 3:]
    assert torch.equal(out[..., :3], cameras[..., :3])
    assert torch.equal(out[:, :, 3], cameras[:, :, 3])
    assert factor.min() >= 1 / 1.5 - 1e-6
    assert factor.max() <= 1.5 + 1e-6
    torch.testing.assert_close(factor, factor[:, :1, :1, :1].expand_as(factor))
    assert told is not None
    assert torch.equal(told[:, :, :10], hints[:, :, :10])
    torch.testing.assert_close(
        hints[:, :, 10:] / told[:, :, 10:], factor[:, :1, :1, :1, None].float().expand(6, 5, 2, 2, 2)
    )


def test_scores_tell_right_cameras_from_wrong_ones() -> None:
    torch.manual_seed(0)
    truth = torch.rand(1, 5, 3, 8, 8)
    pose = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    pose[:, 0, 3] = torch.arange(5.0)
    cameras = Cameras(torch.eye(3, dtype=torch.float64).repeat(5, 1, 1), pose, torch.full((5, 2), 8))
    scenes = HeldOut(("dtu",), truth, (cameras,))
    right = scores((truth[:, 2:] + 0.01).clamp(0, 1), scenes, 2, 7)[0]
    swapped = scores((truth[:, 2:] + 0.01).clamp(0, 1).flip(1), scenes, 2, 7)[0]
    assert right["psnr_right_db"] > 39
    assert right["psnr_wrong_db"] < 12
    assert right["matched"] == 1
    assert swapped["psnr_right_db"] < right["psnr_right_db"] - 10
    assert swapped["matched"] == pytest.approx(1 / 3)  # the middle one stays where it was


def test_settings_reach_nested_fields() -> None:
    document = settings_document(["model.unet.camera=vector"])
    assert training_config("default", {}, ["model.unet.camera=vector"]).model.unet["camera"] == "vector"
    assert document == {"model": {"unet": {"camera": "vector"}}}


@pytest.mark.slow
def test_the_recipe_in_short_follows_the_cameras(tmp_path: Path) -> None:
    """A third of the 10-minute recipe: the loss falls, and samples look like the views from their own cameras more than
    like the other targets' views, of which a model blind to cameras could not tell them (chance: 0 dB, matched 0.2)."""
    settings = ["bank.scenes=120", "autoencoder.minutes=0.75", "sample_scenes=12", "log_steps=25", "sample_minutes=60"]
    run("recipe_10_minutes", "--out", tmp_path, "--steps", "700", *[a for s in settings for a in ("--set", s)])
    losses = [row["loss"] for row in read_rows(tmp_path / "training", TRAINING).to_pylist()]
    assert sum(losses[-4:]) / 4 < 0.75 * losses[0]  # fine channels of the latents stay unknown
    samples = read_rows(tmp_path / "samples", SAMPLES).to_pylist()
    assert {one["step"] for one in samples} == {700}
    gain_db = sum(one["psnr_right_db"] - one["psnr_wrong_db"] for one in samples) / len(samples)
    matched = sum(one["matched"] for one in samples) / len(samples)
    assert gain_db > 0.15
    assert matched > 0.25
