"""Training a model with hints: groups are predicted once, in whole shards, and a network without hints can start it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from cat3d_core.diffusion import Autoencoder, load_model, save_model
from cat3d_core.matching.checkpoint import save_sweep
from cat3d_core.matching.network import SweepNetwork
from cat3d_core.matching.warp import views
from cat3d_core.random import generator
from flows.commands.train import train_command
from flows.training import hint_bank
from flows.training.hint_bank import load_hint_bank, sources
from flows.training.model import model_config, starting_config, starting_model
from flows.training.sweep_batches import cameras_of, prepared
from schemas.errors import ConfigError
from tests.flows.stages.test_match import TINY as TINY_SWEEP

TINY = """
name: tiny
model: {size: tiny, image_size: 32, unet: {max_3d_size: 8, hints: true}, views: 4}
bank: {families: [dtu, llff], scenes: 4, views: 4, variants: 1, folder: BANK, sweep: SWEEP}
autoencoder: {minutes: 0.02, shipped: false, batch: 4}
optimizer: {learning_rate: 1.0e-3, warmup_steps: 2, groups: 2, precision: float32}
conditions: [1, 2]
steps: 4
sample_minutes: 60
sample_steps: 2
"""


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hints")
    torch.manual_seed(0)
    save_sweep(folder / "sweep.safetensors", SweepNetwork(TINY_SWEEP), {})
    path = folder / "tiny.yaml"
    path.write_text(TINY.replace("BANK", str(folder / "bank")).replace("SWEEP", str(folder / "sweep.safetensors")))
    return path


@pytest.fixture(scope="module")
def trained(settings: Path) -> Path:
    out = settings.parent / "out"
    train_command(str(settings), out, {}, [], False)
    return out


def test_a_training_with_hints_leaves_a_model_that_takes_them(trained: Path) -> None:
    model = load_model(trained / "model.safetensors")
    assert model.config.unet.hints
    bank = load_hint_bank(trained.parent / "bank", 32)
    assert len(bank) == 4 * 2
    assert sorted(bank.given.tolist()) == [1] * 4 + [2] * 4
    assert not bank.hints[torch.arange(8), bank.given - 1].any()  # of given views
    assert bool((bank.hints[:, -1, 8:].float() >= 0).all())  # maps of targets
    assert bank.hints[:, -1, 9].float().max() <= 1


def test_shards_that_are_there_are_not_predicted_again(
    settings: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(hint_bank, "hinted_group", never)
    train_command(str(settings), trained, {}, [], False)


def test_a_bank_belongs_to_one_plane_sweep(settings: Path, trained: Path) -> None:
    torch.manual_seed(1)
    other = settings.parent / "other.safetensors"
    save_sweep(other, SweepNetwork(TINY_SWEEP), {})
    with pytest.raises(ConfigError, match="other settings"):
        train_command(str(settings), settings.parent / "new", {}, [f"bank.sweep={other}"], False)


def test_first_shards_of_other_folders_are_held_out(settings: Path, trained: Path) -> None:
    bank = settings.parent / "bank"
    assert [name for name, _ in sources(bank, [])] == ["0_00000.safetensors"]
    assert [name for name, _ in sources(bank, [bank])] == ["0_00000.safetensors"]


def test_a_network_without_hints_can_start_one_with_them(tmp_path: Path) -> None:
    small: dict = {"max_3d_size": 8}
    plain, hinted = (model_config("tiny", 32, 4, small | {"hints": on}) for on in (False, True))
    model = starting_model(plain, Autoencoder(plain.autoencoder), None, 0)
    save_model(tmp_path / "plain.safetensors", model, {})
    assert starting_config(hinted, tmp_path / "plain.safetensors") == hinted
    started = starting_model(hinted, model.autoencoder, tmp_path / "plain.safetensors", 0)
    weight = started.unet.conv_in.weight
    assert torch.equal(weight[:, :-12], model.unet.conv_in.weight)
    assert not weight[:, -12:].any()
    save_model(tmp_path / "hinted.safetensors", started, {})
    with pytest.raises(ValueError, match="hints is True there and False here"):
        starting_config(plain, tmp_path / "hinted.safetensors")


def test_views_become_the_cameras_that_they_were(settings: Path, trained: Path) -> None:
    shard = load_file(trained.parent / "bank" / "renders" / "00000.safetensors")
    raw = {name: shard[name][0] for name in ("image", "intrinsics", "world_from_camera")}
    raw["inverse_depth"] = torch.zeros(4, 32, 32)
    scene = prepared(raw, 32, generator(0))
    back = cameras_of(scene.views, 32)
    torch.testing.assert_close(back.intrinsics, raw["intrinsics"].double())
    torch.testing.assert_close(views(back).k, scene.views.k)
