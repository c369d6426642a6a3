"""Text to a scene, with a tiny random pipeline and a tiny random CLIP that the test makes."""

from __future__ import annotations

import json
import string
from pathlib import Path

import pytest
import torch

from flows.errors import InputError
from flows.generation.text import Prompt, make_prompt, text_to_photo
from flows.media.images import read_image
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from tests.flows.conftest import TINY

TEXT = "A red chair"
SIDE = 64


def _tokenizer(folder: Path):
    """Of letters alone."""
    from transformers import CLIPTokenizer

    letters = string.ascii_lowercase
    tokens = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    return CLIPTokenizer.from_pretrained(str(folder), model_max_length=16)


def _text_config():
    from transformers import CLIPTextConfig

    return CLIPTextConfig(
        vocab_size=54, hidden_size=32, intermediate_size=64, num_hidden_layers=1, num_attention_heads=2,
        max_position_embeddings=16, projection_dim=24, bos_token_id=52, eos_token_id=53, pad_token_id=53,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from diffusers import AutoencoderKL, PNDMScheduler, StableDiffusionPipeline, UNet2DConditionModel
    from transformers import CLIPTextModel

    folder = tmp_path_factory.mktemp("pipeline")
    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        block_out_channels=(32, 64), layers_per_block=1, sample_size=8, cross_attention_dim=32, attention_head_dim=8,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=(16,) * 4, down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4, latent_channels=4, norm_num_groups=8,
    )  # fmt: skip
    StableDiffusionPipeline(
        vae=vae, text_encoder=CLIPTextModel(_text_config()), tokenizer=_tokenizer(folder / "words"), unet=unet,
        scheduler=PNDMScheduler(skip_prk_steps=True, steps_offset=1), safety_checker=None, feature_extractor=None,
        requires_safety_checker=False,
    ).save_pretrained(folder / "saved")  # fmt: skip
    return folder / "saved"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from transformers import CLIPConfig, CLIPModel, CLIPVisionConfig

    folder = tmp_path_factory.mktemp("clip")
    torch.manual_seed(1)
    vision = CLIPVisionConfig(
        hidden_size=64, intermediate_size=64, num_hidden_layers=1, num_attention_heads=1, image_size=32, patch_size=8,
        projection_dim=24,
    )  # fmt: skip
    config = CLIPConfig(text_config=_text_config().to_dict(), vision_config=vision.to_dict(), projection_dim=24)
    CLIPModel(config).save_pretrained(folder)
    _tokenizer(folder / "words").save_pretrained(folder)
    return folder


def test_a_text_is_made_once_and_its_settings_are_kept(pipeline: Path, tmp_path: Path, capsys) -> None:
    asked = make_prompt(TEXT, pipeline, 0, "{steps: 2, guidance: 5.0, side: 64}")
    folder = text_to_photo(asked, tmp_path)
    photo, _ = read_image(folder / "photo.png")
    assert photo.shape == (SIDE, SIDE, 3)
    changed = (folder / "photo.png").stat().st_mtime_ns
    assert text_to_photo(asked, tmp_path) == folder
    assert (folder / "photo.png").stat().st_mtime_ns == changed
    document = json.loads((folder / "prompt.json").read_text())["settings"]
    assert {name: document[name] for name in ("text", "seed", "steps", "side")} == {
        "text": TEXT, "seed": 0, "steps": 2, "side": 64,
    }  # fmt: skip
    assert document["pipeline_class"] == "StableDiffusionPipeline"
    other = text_to_photo(make_prompt(TEXT, pipeline, 1, "{steps: 2, side: 64}"), tmp_path)
    assert other != folder
    assert (read_image(other / "photo.png")[0] != photo).any()


def test_a_damaged_photo_is_made_again(pipeline: Path, tmp_path: Path) -> None:
    asked = Prompt(TEXT, pipeline, steps=1, side=SIDE)
    folder = text_to_photo(asked, tmp_path)
    photo = (folder / "photo.png").read_bytes()
    (folder / "photo.png").write_bytes(b"")
    assert text_to_photo(asked, tmp_path) == folder
    assert (folder / "photo.png").read_bytes() == photo


def test_text_to_a_scene_with_scores(cat3d, pipeline: Path, clip: Path, tmp_path: Path, monkeypatch) -> None:
    """The photo is the scene's, marked with the text; frames are scored with both."""
    monkeypatch.setenv("CAT3D_CLIP_WEIGHTS", str(clip))
    views = TINY.index("--views")
    small = [*TINY[:views], *TINY[views + 2 :]]
    done = cat3d("run", "--prompt", TEXT, "--text-to-image", str(pipeline), "--text-settings", "{steps: 2, side: 64}",
                 "--out", str(tmp_path), *small, "--set", "plan.views=4", "--set", "sample.steps=1",
                 "--set", "skip.coverage=false", timeout=1500)  # fmt: skip
    (path,) = tmp_path.glob("*.zarr")
    store = SceneStore.open(path)
    assert store.captured.attrs["made_from"]["text"] == TEXT
    record = store.record("ingest")
    assert record is not None
    assert any(f"made from the text “{TEXT}”" in d.text for d in record.decisions)
    (run,) = store.runs()
    assert run == "vall-cat3d"
    told = store.record("evaluate", run)
    assert told is not None
    (said,) = [d.text for d in told.decisions if "CLIP score" in d.text]
    assert "2 frames of the video" in said
    assert "with the photo, " in said
    assert said.endswith("with the text.")
    assert "CLIP score" in (tmp_path / "report.html").read_text()
    assert "Report:" in done.stdout


@pytest.mark.parametrize(
    ("text", "settings", "sentence"),
    [
        ("", "", "--prompt is empty"),
        (TEXT, "{steps: 0}", "steps must be one of"),
        (TEXT, "{size: 3}", "size must be one of steps, guidance, side"),
        (TEXT, "{steps: [", "not valid YAML"),
        (TEXT, "fast", "fast must be one of"),
    ],
)
def test_what_makes_no_sense_is_refused(pipeline: Path, tmp_path: Path, text, settings, sentence) -> None:
    with pytest.raises((InputError, ConfigError), match=sentence):
        text_to_photo(make_prompt(text, pipeline, 0, settings), tmp_path)


def test_folders_without_a_pipeline_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no model_index.json"):
        text_to_photo(Prompt(TEXT, tmp_path), tmp_path)
    (tmp_path / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusionPipeline"}))
    with pytest.raises(InputError, match="can't be loaded"):
        text_to_photo(Prompt(TEXT, tmp_path), tmp_path)


def test_the_command_takes_a_folder_or_a_text(cat3d, tmp_path: Path) -> None:
    for arguments in (["--prompt", TEXT], [str(tmp_path), "--prompt", TEXT], []):
        done = cat3d("run", *arguments, check=False)
        assert done.returncode == 2
        assert "Give the scene's folder, or --prompt and --text-to-image." in " ".join(done.stderr.split())
