"""Stable Diffusion layouts and foreign autoencoders, with diffusers as the oracle (random weights, made on the
spot)."""

from __future__ import annotations

import json
import re

import pytest
import torch
from safetensors.torch import load_file, save_file

from cat3d_core.diffusion.foreign_autoencoders import load_autoencoder, load_taesd
from cat3d_core.diffusion.pretrained import export_2d, inflate, load_stable_diffusion
from cat3d_core.diffusion.unet import MultiViewUNet
from tests.core.diffusion.models import matrices

SD1 = {"attention_head_dim": 8, "use_linear_projection": False, "cross_attention_dim": 24}
SD2 = {"attention_head_dim": [1, 2, 2], "use_linear_projection": True, "cross_attention_dim": 40}
CHANNELS = (64, 128, 128)


def _oracle(layout):
    from diffusers import UNet2DConditionModel

    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        sample_size=8,
        block_out_channels=CHANNELS,
        layers_per_block=2,
        down_block_types=("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
        **layout,
    ).eval()
    return unet.requires_grad_(False)


def _compare(oracle, unet, token):
    g = torch.Generator().manual_seed(1)
    x, time = torch.randn(3, 4, 8, 8, generator=g), torch.tensor([3.0, 500.0, 998.0])
    expected = oracle(x, time, encoder_hidden_states=token.expand(3, 1, -1)).sample
    cameras, mask = matrices(3, 1, g), torch.ones(3, 1)
    with torch.no_grad():
        got = unet.eval()(x[:, None], time, cameras, mask)[:, 0]
    # Two orders of summation in float32 through some 60 layers.
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("layout", [SD1, SD2], ids=["SD1", "SD2"])
def test_folder_gives_the_2d_output_with_text_folded(layout, tmp_path):
    oracle = _oracle(layout)
    oracle.save_pretrained(tmp_path / "unet")
    token = torch.randn(layout["cross_attention_dim"], generator=torch.Generator().manual_seed(2))
    unet, report = load_stable_diffusion(tmp_path, token, latent_size=8, max_3d_size=8)
    _compare(oracle, unet, token)
    names = set(oracle.state_dict())
    assert set(report.taken) | set(report.widened) | set(report.folded) == names
    assert not report.left
    assert report.widened == ["conv_in.weight"]
    assert not report.fresh
    assert report.folded
    assert all(".attn2." in n or ".norm2." in n for n in report.folded)
    # Round trip: the 2D network inside, put back, is the same network.
    again = MultiViewUNet(unet.config)
    assert not inflate(again, export_2d(unet)).fresh
    assert all(torch.equal(a, b) for a, b in zip(unet.state_dict().values(), again.state_dict().values(), strict=True))


def _ldm_names(weights):
    """diffusers -> original key names, written independently of the reader (blocks per level: 2)."""
    ends = {
        "time_embedding.linear_1": "time_embed.0",
        "time_embedding.linear_2": "time_embed.2",
        "conv_in": "input_blocks.0.0",
        "conv_norm_out": "out.0",
        "conv_out": "out.2",
    }
    parts = {
        "norm1": "in_layers.0",
        "conv1": "in_layers.2",
        "time_emb_proj": "emb_layers.1",
        "norm2": "out_layers.0",
        "conv2": "out_layers.3",
        "conv_shortcut": "skip_connection",
    }
    result = {}
    for name, value in weights.items():
        stem, leaf = name.rsplit(".", 1)
        if stem in ends:
            new = f"{ends[stem]}.{leaf}"
        elif m := re.match(r"(down|up)_blocks\.(\d)\.(resnets|attentions|downsamplers|upsamplers)\.(\d)\.(.+)", name):
            side, level, kind, block, rest = m[1], int(m[2]), m[3], int(m[4]), m[5]
            base = 3 * level + block + (1 if side == "down" else 0)
            number = f"{'input' if side == 'down' else 'output'}_blocks.{base}"
            if kind == "downsamplers":
                new = f"input_blocks.{3 * level + 3}.0.op.{leaf}"
            elif kind == "upsamplers":
                new = f"output_blocks.{3 * level + 2}.{2 if level > 0 else 1}.conv.{leaf}"
            elif kind == "resnets":
                key, tail = rest.split(".", 1)
                new = f"{number}.0.{parts[key]}.{tail}"
            else:
                new = f"{number}.1.{rest}"
        elif m := re.match(r"mid_block\.resnets\.(\d)\.(\w+)\.(\w+)", name):
            new = f"middle_block.{2 * int(m[1])}.{parts[m[2]]}.{m[3]}"
        else:
            new = name.replace("mid_block.attentions.0", "middle_block.1")
        result[f"model.diffusion_model.{new}"] = value
    return result


def test_single_file_in_the_original_layout(tmp_path):
    """Heads follow from shapes here: 8 for SD1's convolutional projections."""
    oracle = _oracle(SD1)
    weights = {k: v.contiguous() for k, v in _ldm_names(oracle.state_dict()).items()}
    assert len(weights) == len(oracle.state_dict())
    save_file({**weights, "first_stage_model.x": torch.zeros(1)}, tmp_path / "sd.safetensors")
    unet, report = load_stable_diffusion(tmp_path / "sd.safetensors", torch.zeros(24), latent_size=8)
    _compare(oracle, unet, torch.zeros(24))
    assert not report.left
    assert not report.fresh


def test_linear_projections_mean_64_channels_a_head(tmp_path):
    save_file({k: v.contiguous() for k, v in _oracle(SD2).state_dict().items()}, tmp_path / "sd.safetensors")
    unet, _ = load_stable_diffusion(tmp_path / "sd.safetensors")
    assert unet.config.heads == (1, 2, 2)
    assert unet.config.linear_projection


def test_changed_networks_are_accounted_for(tmp_path):
    _oracle(SD2).save_pretrained(tmp_path)
    _, report = load_stable_diffusion(tmp_path, latent_channels=8)
    assert report.widened == ["conv_in.weight"]
    assert sorted(report.left) == ["conv_out.bias", "conv_out.weight"]
    assert sorted(report.fresh) == ["conv_out.bias", "conv_out.weight"]
    _, report = load_stable_diffusion(tmp_path, view_attention="temporal", latent_size=8)
    assert report.fresh
    assert all("_views" in n for n in report.fresh)
    _, report = load_stable_diffusion(tmp_path, camera="vector")
    assert not report.folded
    assert sorted(report.fresh) == ["camera_embedding.bias", "camera_embedding.weight"]


def test_other_files_are_refused(tmp_path):
    save_file({"a.weight": torch.zeros(2)}, tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match="no Stable Diffusion U-Net"):
        load_stable_diffusion(tmp_path / "a.safetensors")
    weights = {k: v.contiguous() for k, v in _oracle(SD2).state_dict().items()}
    save_file({**weights, "add_embedding.linear_1.weight": torch.zeros(2, 2)}, tmp_path / "xl.safetensors")
    with pytest.raises(ValueError, match="add_embedding"):
        load_stable_diffusion(tmp_path / "xl.safetensors")
    with pytest.raises(FileNotFoundError):
        load_stable_diffusion(tmp_path / "none.safetensors")


@pytest.mark.parametrize("quant", [True, False])
def test_kl_autoencoder_agrees_with_diffusers(quant, tmp_path):
    from diffusers import AutoencoderKL

    torch.manual_seed(0)
    oracle = AutoencoderKL(
        block_out_channels=(16, 32, 32, 32),
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        layers_per_block=2,
        latent_channels=8,
        norm_num_groups=8,
        scaling_factor=0.3,
        shift_factor=0.1,
        use_quant_conv=quant,
        use_post_quant_conv=quant,
    ).eval()
    oracle.save_pretrained(tmp_path)
    ours = load_autoencoder(tmp_path)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        latents = (oracle.encode(images * 2 - 1).latent_dist.mean - 0.1) * 0.3
        decoded = (oracle.decode(latents / 0.3 + 0.1).sample / 2 + 0.5).clamp(0, 1)
    torch.testing.assert_close(ours.encode(images), latents, rtol=0, atol=1e-5)
    torch.testing.assert_close(ours.decode(latents), decoded, rtol=0, atol=1e-5)


def test_tiny_autoencoder_agrees_with_diffusers(tmp_path):
    from diffusers import AutoencoderTiny

    torch.manual_seed(0)
    oracle = AutoencoderTiny(
        encoder_block_out_channels=(16,) * 4, decoder_block_out_channels=(16,) * 4, latent_channels=8
    ).eval()
    oracle.save_pretrained(tmp_path)
    ours = load_autoencoder(tmp_path)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        latents = oracle.encode(images * 2 - 1).latents
        decoded = (oracle.decode(latents).sample / 2 + 0.5).clamp(0, 1)
    torch.testing.assert_close(ours.encode(images), latents, rtol=0, atol=1e-5)
    torch.testing.assert_close(ours.decode(latents), decoded, rtol=0, atol=1e-5)


def test_unknown_autoencoders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="config.json"):
        load_autoencoder(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"_class_name": "VQModel"}))
    save_file({"a": torch.zeros(1)}, tmp_path / "diffusion_pytorch_model.safetensors")
    with pytest.raises(ValueError, match="VQModel"):
        load_autoencoder(tmp_path)


def test_real_foreign_autoencoder_on_photographs(shared_weights, shared_data):
    """TAESD for FLUX.2: 29.3 dB on the fox photographs at 128 pixels (measured elsewhere)."""
    from flows.media.images import read_image

    model = load_taesd(shared_weights / "taef2_encoder.safetensors", shared_weights / "taef2_decoder.safetensors")
    files = sorted((shared_data / "fox").rglob("*.jpg"))[:4]
    if not files:
        pytest.skip("No fox photographs found.")
    pictures = []
    for file in files:
        image = torch.from_numpy(read_image(file)[0][..., :3].copy()).permute(2, 0, 1)[None].float() / 255
        side = min(image.shape[-2:])
        top, left = (image.shape[-2] - side) // 2, (image.shape[-1] - side) // 2
        image = image[..., top : top + side, left : left + side]
        pictures.append(torch.nn.functional.interpolate(image, (128, 128), mode="bicubic", antialias=True).clamp(0, 1))
    images = torch.cat(pictures)
    psnr = -10 * (model.decode(model.encode(images)) - images).square().mean((1, 2, 3)).log10()
    assert 27 < float(psnr.mean()) < 33
    assert "conv.0.weight" in "".join(load_file(shared_weights / "taef2_encoder.safetensors"))
