"""Reading SEVA's files: recognised, every weight accounted for, never taken for Stable Diffusion's."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file

from cat3d_core.diffusion.pretrained import load_stable_diffusion
from cat3d_core.seva.checkpoint import find_seva, load_seva, random_seva, read_config, save_seva
from cat3d_core.seva.config import TINY
from cat3d_core.seva.image_prompt import embed
from cat3d_core.seva.model import load_seva_model
from tests.core.seva.models import inputs, write_parts


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("seva") / "modelv1.1.safetensors"
    save_seva(path, random_seva(TINY, seed=1))
    return path


def _changed(file, tmp_path, change):
    weights = load_file(file)
    change(weights)
    path = tmp_path / "model.safetensors"
    save_file(weights, path, {"cat3d_seva": json.dumps({"head_channels": 16})})
    return path


def test_round_trip(file):
    assert len(load_file(file)) == 1146
    assert read_config(file) == TINY
    network = load_seva(file)
    given = inputs(1, 3, 8, 8)
    assert torch.equal(network.folded(*given, 3), random_seva(TINY, seed=1).folded(*given, 3))
    assert not any(p.requires_grad for p in network.parameters())


def test_the_numbers_type_is_the_files_or_what_is_asked_for(file, tmp_path):
    half = _changed(file, tmp_path, lambda w: w.update({name: t.half() for name, t in w.items()}))
    assert {p.dtype for p in load_seva(half).parameters()} == {torch.float16}
    assert {p.dtype for p in load_seva(half, dtype=torch.float32).parameters()} == {torch.float32}


def test_heads_of_a_file_without_description_have_64_channels(file, tmp_path):
    save_file(load_file(file), tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="model.safetensors describes no network .* heads of 64 channels"):
        read_config(tmp_path / "model.safetensors")


def test_folders_are_searched(file, tmp_path):
    assert find_seva(file.parent) == file
    assert find_seva(file) == file
    assert find_seva(tmp_path) is None
    save_file({"a": torch.zeros(1)}, tmp_path / "model.safetensors")
    assert find_seva(tmp_path) is None
    assert find_seva(tmp_path / "model.safetensors") is None
    (tmp_path / "model.safetensors").unlink()
    for name in ("model.safetensors", "modelv1.1.safetensors"):
        shutil.copy(file, tmp_path / name)
    with pytest.raises(ValueError, match="two versions of SEVA: name modelv1.1.safetensors"):
        find_seva(tmp_path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda w: w.pop("output_blocks.5.2.conv.bias"), "output_blocks.5.2.conv.bias is missing"),
        (lambda w: w.update({"extra.weight": torch.zeros(1)}), "extra.weight is unknown"),
        (lambda w: w.update({"time_embed.0.bias": torch.zeros(3)}), "time_embed.0.bias has another shape"),
        (lambda w: w.pop("input_blocks.4.0.in_layers.2.weight"), "input_blocks.4.0.in_layers.2.weight is missing"),
        (lambda w: w["out.2.bias"].fill_(torch.nan), "out.2.bias has a NaN"),
        (lambda w: w.update({"out.2.bias": w["out.2.bias"].double()}), "out.2.bias is torch.float64"),
    ],
)
def test_odd_files_are_refused_with_the_weight(file, tmp_path, change, fault):
    path = _changed(file, tmp_path, change)
    with pytest.raises(ValueError, match=fault) as error:
        load_seva(path)
    assert str(path) in str(error.value)


def test_other_files_are_no_seva(tmp_path):
    save_file({"input_blocks.0.0.weight": torch.zeros(32, 4, 3, 3)}, tmp_path / "sd.safetensors")
    (tmp_path / "text.safetensors").write_text("no tensors")
    for name in ("sd.safetensors", "text.safetensors", "absent.safetensors"):
        assert find_seva(tmp_path / name) is None
        with pytest.raises(ValueError, match="no weights of SEVA"):
            read_config(tmp_path / name)


def test_training_does_not_start_from_seva(file, tmp_path):
    """Nor from its folder, nor where a program has put its prefix before the names."""
    prefixed = {f"model.diffusion_model.{name}": t for name, t in load_file(file).items()}
    save_file(prefixed, tmp_path / "prefixed.safetensors")
    for path in (file, file.parent, tmp_path / "prefixed.safetensors"):
        with pytest.raises(ValueError, match="Stability AI Non-Commercial License"):
            load_stable_diffusion(path)


def test_model_from_its_three_parts(file, tmp_path):
    vae, tower_file, tower = write_parts(tmp_path)
    model = load_seva_model(file, vae, tower_file)
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    latents = model.encode(images)
    assert latents.shape == (2, 4, 8, 16)
    assert model.decode(latents).shape == images.shape
    torch.testing.assert_close(model.embed(images), embed(tower, images), rtol=0, atol=1e-5)


def test_parts_of_other_models_are_refused(file, tmp_path):
    for folder, changes in (("a", {"channels": 8}), ("b", {"scale": 0.3611})):
        vae, tower, _ = write_parts(tmp_path / folder, **changes)
        with pytest.raises(ValueError, match="not the autoencoder of Stable Diffusion 2.1"):
            load_seva_model(file, vae, tower)
    vae, tower, _ = write_parts(tmp_path, dimensions=16)
    with pytest.raises(ValueError, match="not OpenCLIP's ViT-H/14: its embeddings have 16 dimensions"):
        load_seva_model(file, vae, tower)
