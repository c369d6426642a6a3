"""Configuration and checkpoint files."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cat3d_core.diffusion import SIZES, ModelConfig, MultiViewModel, describe, load_model, save_model, weights_hash
from tests.core.diffusion.models import random_model, tiny


@pytest.mark.parametrize("name", sorted(SIZES))
def test_configuration_survives_json(name):
    config = SIZES[name]
    assert ModelConfig.from_json(config.to_json()) == config
    changed = dataclasses.replace(
        config, views=4, unet=dataclasses.replace(config.unet, camera="vector", decoder_only=True)
    )
    assert ModelConfig.from_json(changed.to_json()) == changed != config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"wings": 2}', "no field wings"),
        ('{"views": "eight"}', "views can't be 'eight'"),
        ('{"unet": {"camera": "sextant"}}', "camera can't be 'sextant'"),
        ('{"views": 1}', "conditioning and a target"),
        ('{"unet": {"heads": [3, 3, 3, 3]}}', "heads"),
    ],
)
def test_wrong_configuration_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        ModelConfig.from_json(text)


@pytest.mark.parametrize("dtype", [None, torch.float16])
def test_checkpoint_round_trip(tmp_path, dtype):
    model = random_model()
    digest = save_model(tmp_path / "m.safetensors", model, {"data": "none", "steps": 3}, dtype)
    loaded = load_model(tmp_path / "m.safetensors")
    assert loaded.config == model.config
    assert not list(tmp_path.glob("*.partial"))
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value.to(dtype or value.dtype).float(), rtol=0, atol=0)
    about = describe(tmp_path / "m.safetensors")
    assert about["provenance"] == {"data": "none", "steps": 3}
    assert about["sha256"] == digest != about["encoder_sha256"]
    model.autoencoder.decoder[0].bias.data.add_(1)
    save_model(tmp_path / "decoder.safetensors", model, {}, dtype)
    assert describe(tmp_path / "decoder.safetensors")["encoder_sha256"] == about["encoder_sha256"]
    model.autoencoder.latent_std.add_(1)
    save_model(tmp_path / "scale.safetensors", model, {}, dtype)
    assert describe(tmp_path / "scale.safetensors")["encoder_sha256"] != about["encoder_sha256"]
    if dtype is None:
        assert weights_hash(loaded.state_dict()) == digest


def test_damaged_foreign_and_missing_files_are_refused(tmp_path):
    path = tmp_path / "m.safetensors"
    save_model(path, random_model(), {})
    data = bytearray(path.read_bytes())
    data[-1000] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match="damaged"):
        load_model(path)
    path.write_bytes(data[:100])
    with pytest.raises(ValueError, match="not a readable safetensors"):
        load_model(path)
    with pytest.raises(FileNotFoundError, match="no model file"):
        load_model(tmp_path / "absent")
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="no cat3d model"):
        load_model(path)


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    model = MultiViewModel(tiny())
    with torch.no_grad():
        model.unet.conv_in.weight[0, 0, 0, 0] = 1e30
    with pytest.raises(ValueError, match="not finite"):
        save_model(tmp_path / "m.safetensors", model, {}, torch.float16)
