"""The CLIP image tower against OpenAI's formulation in torch's own layers, and against transformers where installed.

Random weights of a small shape: the trained ones are the user's. Tolerance 1e-5 on unit embeddings in float32.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import nn

from cat3d_core.metrics.clip import ClipConfig, ClipImageTower, find_clip, load_clip, prepared

SMALL = ClipConfig(width=64, layers=2, hidden=128, patch=8, size=32, dimensions=16, heads=1)


class OpenAIBlock(nn.Module):
    """ResidualAttentionBlock of openai/CLIP, which leaves attention to nn.MultiheadAttention."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.ln_1, self.ln_2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mlp = nn.ModuleDict({"c_fc": nn.Linear(width, 2 * width), "c_proj": nn.Linear(2 * width, width)})

    def forward(self, x):
        y = self.ln_1(x)
        x = x + self.attn(y, y, y, need_weights=False)[0]
        hidden = self.mlp["c_fc"](self.ln_2(x))
        return x + self.mlp["c_proj"](hidden * torch.sigmoid(1.702 * hidden))


class OpenAITower(nn.Module):
    """VisionTransformer of openai/CLIP."""

    def __init__(self, width: int = 128, heads: int = 2, patch: int = 8, size: int = 32, dimensions: int = 16) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, patch, patch, bias=False)
        self.class_embedding = nn.Parameter(torch.randn(width))
        self.positional_embedding = nn.Parameter(torch.randn((size // patch) ** 2 + 1, width))
        self.ln_pre, self.ln_post = nn.LayerNorm(width), nn.LayerNorm(width)
        self.transformer = nn.ModuleDict({"resblocks": nn.ModuleList(OpenAIBlock(width, heads) for _ in range(2))})
        self.proj = nn.Parameter(torch.randn(width, dimensions))

    def forward(self, x):
        x = self.conv1(x).flatten(2).permute(0, 2, 1)
        x = torch.cat([self.class_embedding.expand(len(x), 1, -1), x], 1) + self.positional_embedding
        x = self.ln_pre(x)
        for block in self.transformer["resblocks"]:
            x = block(x)
        return self.ln_post(x[:, 0]) @ self.proj


def randomised(module: nn.Module) -> nn.Module:
    g = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=g)
    return module.eval()


@pytest.fixture
def openai_file(tmp_path):
    """An OpenAI-style file with a bit of text tower in it, and the tower that made it."""
    tower = randomised(OpenAITower())
    state = {f"visual.{k}": v.contiguous() for k, v in tower.state_dict().items()}
    path = tmp_path / "open_clip.safetensors"
    save_file(state | {"logit_scale": torch.zeros(()), "token_embedding.weight": torch.zeros(3, 4)}, path)
    return path, tower


def unit(x):
    return torch.nn.functional.normalize(x, dim=-1)


def test_agrees_with_openais_formulation(openai_file):
    path, theirs = openai_file
    ours = load_clip(path)
    images = torch.rand(3, 3, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(ours(images), unit(theirs(prepared(images, 32))), rtol=0, atol=1e-5)
        score = ours.score(images, images.flip(0))
        assert float(score[1]) == pytest.approx(1.0, abs=1e-5)
        torch.testing.assert_close(score, (ours(images) * ours(images.flip(0))).sum(-1))
    assert ours.name.startswith("clip-vit-128x2/8-32-quickgelu ")


@pytest.mark.parametrize(("activation", "heads"), [("quick_gelu", 4), ("gelu", 8)])
def test_agrees_with_transformers(tmp_path, activation, heads):
    transformers = pytest.importorskip("transformers")
    config = transformers.CLIPVisionConfig(
        hidden_size=128, intermediate_size=256, num_hidden_layers=2, num_attention_heads=heads, image_size=32,
        patch_size=8, projection_dim=16, hidden_act=activation,
    )  # fmt: skip
    theirs = randomised(transformers.CLIPVisionModelWithProjection(config))
    theirs.save_pretrained(tmp_path)
    ours = load_clip(tmp_path / "model.safetensors")
    images = torch.rand(2, 3, 32, 32)
    with torch.no_grad():
        expected = unit(theirs(pixel_values=prepared(images, 32)).image_embeds)
        torch.testing.assert_close(ours(images), expected, rtol=0, atol=1e-5)


def test_hugging_face_keys_without_the_package(openai_file, tmp_path):
    """The same tower under the other names gives the same embeddings."""
    path, theirs = openai_file
    names = {
        "class_embedding": "embeddings.class_embedding", "positional_embedding": "embeddings.position_embedding.weight",
        "conv1.weight": "embeddings.patch_embedding.weight", "ln_pre": "pre_layrnorm", "ln_post": "post_layernorm",
        "transformer.resblocks": "encoder.layers", "ln_": "layer_norm", "attn.out_proj": "self_attn.out_proj",
        "mlp.c_fc": "mlp.fc1", "mlp.c_proj": "mlp.fc2",
    }  # fmt: skip
    state = {}
    for key, value in theirs.state_dict().items():
        if key == "proj":
            state["visual_projection.weight"] = value.T.contiguous()
            continue
        for old, new in names.items():
            key = key.replace(old, new)
        if "in_proj_" in key:
            for name, part in zip("qkv", value.chunk(3)):
                state["vision_model." + key.replace("attn.in_proj_", f"self_attn.{name}_proj.")] = part.contiguous()
        else:
            state["vision_model." + key] = value
    save_file(state, tmp_path / "model.safetensors")
    images = torch.rand(2, 3, 32, 32)
    torch.testing.assert_close(load_clip(tmp_path / "model.safetensors")(images), load_clip(path)(images))


def test_configuration_beside_the_file_decides_what_tensors_do_not_say(openai_file):
    path, _ = openai_file
    assert load_clip(path).config.quick_gelu
    document = {"model_cfg": {"vision_cfg": {"head_width": 32}}}
    (path.parent / "open_clip_config.json").write_text(json.dumps(document))
    config = load_clip(path).config
    assert (config.heads, config.quick_gelu) == (4, False)
    (path.parent / "config.json").write_text(json.dumps({"vision_config": {"num_attention_heads": 3}}))
    with pytest.raises(ValueError, match="3 heads don't divide"):
        load_clip(path)


def test_input_is_resized_and_cropped_as_pillow_does(real_pairs):
    image = real_pairs[1][:1]
    ours = prepared(image, 64) * torch.tensor([0.26862954, 0.26130258, 0.27577711]).view(1, 3, 1, 1)
    ours = ours + torch.tensor([0.48145466, 0.4578275, 0.40821073]).view(1, 3, 1, 1)
    picture = Image.fromarray((image[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    width = round(picture.width * 64 / picture.height)
    left = (width - 64) // 2
    theirs = np.asarray(picture.resize((width, 64), Image.BICUBIC).crop((left, 0, left + 64, 64))) / 255
    difference = np.abs(ours[0].permute(1, 2, 0).numpy() - theirs)
    # Pillow rounds to 8 bits and clips after each axis.
    assert difference.mean() < 0.5 / 255
    assert difference.max() < 4 / 255


def test_found_by_its_variable_or_not_at_all(openai_file, tmp_path, monkeypatch):
    path, _ = openai_file
    monkeypatch.delenv("CAT3D_CLIP_WEIGHTS", raising=False)
    assert find_clip() is None
    monkeypatch.setenv("CAT3D_CLIP_WEIGHTS", str(path.parent))
    assert find_clip().name == load_clip(path).name
    save_file({"a": torch.zeros(1)}, tmp_path / "another.safetensors")
    with pytest.raises(ValueError, match="CAT3D_CLIP_WEIGHTS: .* holds 2 .safetensors files; name the one"):
        find_clip()
    monkeypatch.setenv("CAT3D_CLIP_WEIGHTS", str(tmp_path / "another.safetensors"))
    with pytest.raises(ValueError, match="CAT3D_CLIP_WEIGHTS: .*another.safetensors: holds no image tower of CLIP"):
        find_clip()


def test_a_file_with_a_layer_missing_is_named(openai_file, tmp_path):
    state = {f"visual.{k}": v for k, v in openai_file[1].state_dict().items()}
    del state["visual.transformer.resblocks.1.mlp.c_fc.bias"]
    save_file(state, tmp_path / "part.safetensors")
    with pytest.raises(ValueError, match=r"part.safetensors: looks like clip-.*, but blocks.1.fc.bias is missing"):
        load_clip(tmp_path / "part.safetensors")


def test_sizes_by_name():
    assert ClipConfig(768, 12, 3072, 16, 224, 512, 12).name == "clip-vit-b/16-224-quickgelu"
    assert ClipImageTower(SMALL).name == "clip-vit-64x2/8-32-quickgelu"
    assert ClipImageTower(SMALL)(torch.rand(1, 3, 20, 50)).shape == (1, 16)
