"""`cat3d train sweep`: it learns, stops, resumes to the same bits, and refuses what does not fit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from cat3d_core.matching.checkpoint import describe_sweep, load_sweep
from cat3d_core.random import generator
from flows.commands.train import kind_of, train_command, training_config
from flows.errors import InputError
from flows.training.sweep import rate_at, shape_of, stage_at, starting_network
from flows.training.sweep_batches import GeometryBank, batch
from schemas.errors import ConfigError
from schemas.sweep_training import SWEEP_TRAINING, SWEEP_VALIDATION, SweepRunConfig
from schemas.tables import read_rows

TINY = """
kind: sweep
network: {encoder: [8, 8, 8, 8], coarse_features: 8, fine_features: 8, photo_planes: 8, target_planes: 8,
          hypotheses: 3, volume: [8, 8, 8], finish: [8, 8, 8, 8]}
bank: {families: [llff, dtu], scenes: 28, views: 5, size: 32, folder: BANK}
stages: [{size: 16, share: 0.5, scenes: 1, targets: 2}, {size: 32, share: 0.5}]
photos: [1, 1, 1]
warmup_steps: 2
precision: float32
log_steps: 2
steps: 6
"""


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    path = folder / "tiny.yaml"
    path.write_text(TINY.replace("BANK", str(folder / "bank")))
    return path


@pytest.fixture(scope="module")
def trained(settings: Path) -> Path:
    out = settings.parent / "whole"
    train_command(str(settings), out, {}, [], False)
    return out


def test_weights_can_be_started_from_with_sharper_blending_and_nothing_else(trained: Path) -> None:
    file = trained / "sweep.safetensors"
    before = load_sweep(file)
    network = starting_network(SweepRunConfig(start=file, steps=1, network={"sharpness": [8.0, 3.0]}))
    assert network.config.sharpness == (8.0, 3.0)
    assert network.config.photo_planes == before.config.photo_planes
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), before.parameters(), strict=True))
    with pytest.raises(ConfigError, match="holds another network"):
        starting_network(SweepRunConfig(start=file, steps=1, network={"photo_planes": 16}))
    with pytest.raises(ConfigError, match="network: .*sharpnes"):
        starting_network(SweepRunConfig(start=file, steps=1, network={"sharpnes": [1.0, 1.0]}))


def test_a_training_leaves_weights_and_tables(trained: Path) -> None:
    network = load_sweep(trained / "sweep.safetensors")
    assert network.config.photo_planes == 8
    assert describe_sweep(trained / "sweep.safetensors")["provenance"]["steps"] == 6
    rows = read_rows(trained / "training", SWEEP_TRAINING).to_pylist()
    assert [row["step"] for row in rows] == [2, 4, 6]
    assert [row["size"] for row in rows] == [16, 32, 32]  # the row of step 4 ends in the second stage
    seen = read_rows(trained / "validation", SWEEP_VALIDATION).to_pylist()
    assert {(row["source"], row["photos"]) for row in seen} == {("bank", 3), ("bank", 1)}


def test_stopped_and_resumed_it_is_the_same_to_the_bit(
    settings: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole_refresh = GeometryBank.refresh

    def interrupt(bank: GeometryBank) -> None:
        if bank._loaded:
            raise KeyboardInterrupt
        whole_refresh(bank)

    out = settings.parent / "legs"
    # The schedule belongs to six steps; the first leg is interrupted where the first checkpoint has been written.
    monkeypatch.setattr(GeometryBank, "refresh", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train_command(str(settings), out, {}, ["save_minutes=1e-9"], False)
    monkeypatch.undo()
    assert int(load_file(out / "state.safetensors")["steps"]) == 1
    train_command(str(settings), out, {}, [], False)
    state = load_file(out / "state.safetensors")
    whole = load_file(trained / "state.safetensors")
    assert all(torch.equal(state[name], whole[name]) for name in whole)


def test_a_finished_training_is_left_alone(settings: Path, trained: Path) -> None:
    before = (trained / "sweep.safetensors").read_bytes()
    train_command(str(settings), trained, {}, [], False)
    assert (trained / "sweep.safetensors").read_bytes() == before


def test_other_settings_are_refused(settings: Path, trained: Path) -> None:
    with pytest.raises(ConfigError, match="other settings"):
        train_command(str(settings), trained, {}, ["learning_rate=0.1"], False)
    with pytest.raises(ConfigError, match="other settings"):
        train_command(str(settings), settings.parent / "new", {}, ["bank.views=6"], False)
    with pytest.raises(InputError, match="no scenes"):
        train_command(str(settings), settings.parent / "nobody", {}, ["bank.others=[/nowhere]"], False)


@pytest.mark.parametrize(
    ("change", "said"),
    [("stages=[{share: 0.5}]", "add up"), ("stages=[{size: 48}]", "does not divide"), ("photos=[0]", "above 0"),
     ("photos=[1,1,1,1,1]", "no target"), ("network={planes: 3}", "planes")],
)  # fmt: skip
def test_impossible_settings_are_refused(settings: Path, change: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        train_command(str(settings), settings.parent / "never", {}, [change], False)


def test_the_preset_is_a_sweep() -> None:
    config = training_config("sweep", {"minutes": 5.0}, [])
    assert isinstance(config, SweepRunConfig)
    assert config.minutes == 5
    assert kind_of(Path("flows/training/presets/default.yaml")) is not SweepRunConfig


def test_schedule() -> None:
    config = training_config("sweep", {}, ["warmup_steps=10"])
    assert isinstance(config, SweepRunConfig)
    assert [stage_at(config, done) for done in (0, 0.34, 0.36, 1)] == [0, 0, 1, 1]
    assert rate_at(config, 0, 0) == pytest.approx(1e-4)
    assert rate_at(config, 0, 100) == pytest.approx(1e-3)
    assert rate_at(config, 1, 100) == pytest.approx(3e-5)
    shapes = {shape_of(config, config.stages[0], step) for step in range(1000)}
    assert {photos for _, photos, _ in shapes} == set(range(1, 10))
    assert all(photos + targets <= 10 for _, photos, targets in shapes)


def test_batches_are_made_of_the_bank_s_scenes(trained: Path, settings: Path) -> None:
    bank = GeometryBank([settings.parent / "bank"])
    drawn = batch(bank, 2, 3, 2, 16, 0.5, generator(0))
    again = batch(bank, 2, 3, 2, 16, 0.5, generator(0))
    assert torch.equal(drawn.image, again.image)
    assert drawn.image.shape == (6, 3, 16, 16)
    assert drawn.truth.shape == (4, 3, 16, 16)
    assert drawn.photos.tolist() == [[0, 1, 2], [0, 1, 2], [3, 4, 5], [3, 4, 5]]
    assert set(drawn.partners[3:].flatten().tolist()) <= {3, 4, 5}
    assert float(drawn.truth_depth.min()) >= 0
