"""Which generator a job has: ours by its file, someone else's through an entry point; nothing is loaded to ask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.diffusion import SIZES, MultiViewModel, save_model
from cat3d_core.generation import Cat3dGenerator
from cat3d_core.generation import cat3d as core
from flows.errors import InputError
from flows.generation import open as opening
from flows.generation.open import forget_generator, format_names, generator_spec, open_generator
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from tests.flows.packages import code_of, install, install_guide
from tests.flows.workers.scene import SOURCE, random_model, run_of, run_stages


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


@pytest.fixture
def nearest_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The package of docs/guides/own_generator.md, installed; its name."""
    return install_guide(tmp_path / "site", monkeypatch, "own_generator.md", opening.GROUP)


def job(out: Path, *settings: str, split: str = "3") -> Job:
    texts = ["method=cat3d", "plan.views=12", "skip={covered_path: false, coverage: false}", *settings]
    return Request(SOURCE, out, (split,), make_config({}, None, texts)).jobs()[0]


def test_our_files_are_recognised_and_described_without_their_weights(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = job(tmp_path, f"sample.checkpoint={model}")
    with monkeypatch.context() as without:
        without.setattr("flows.generation.formats.cat3d.load_model", None)
        spec = generator_spec(one)
    assert (spec.views, spec.image_size, spec.latent_shape) == (8, (64, 64), (8, 8, 8))
    assert len(spec.identity) == len(spec.encoder_identity) == 64
    generator = open_generator(one)
    assert isinstance(generator, Cat3dGenerator)
    assert generator.spec == spec
    assert open_generator(one) is generator, "one copy a process"
    forget_generator()
    assert open_generator(one) is not generator
    shipped = generator_spec(job(tmp_path))
    assert shipped.image_size == (128, 128)
    assert shipped.identity != spec.identity


def test_a_model_that_changes_under_its_name_is_another(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    identities = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        save_model(path, MultiViewModel(SIZES["tiny"]), {})
        identities.append(generator_spec(job(tmp_path, f"sample.checkpoint={path}")).identity)
    assert identities[0] != identities[1]


def test_precision_is_the_networks_alone(model: Path, tmp_path: Path) -> None:
    generator = open_generator(job(tmp_path, f"sample.checkpoint={model}", "sample.precision=bfloat16"))
    assert isinstance(generator, Cat3dGenerator)
    assert next(generator.model.unet.parameters()).dtype == torch.bfloat16
    assert next(generator.model.autoencoder.parameters()).dtype == torch.float32


def test_what_cannot_be_opened_ends_in_a_sentence(model: Path, tmp_path: Path) -> None:
    def refused(*settings: str) -> str:
        with pytest.raises(InputError) as error:
            generator_spec(job(tmp_path, *settings))
        return str(error.value)

    text = tmp_path / "notes.safetensors"
    text.write_text("no weights")
    assert "there is no model file /nowhere.safetensors" in refused("sample.checkpoint=/nowhere.safetensors")
    told = refused(f"sample.checkpoint={text}")
    assert f"{text} is no model that a generator recognises" in told
    assert "cat3d: a .safetensors file that `cat3d train` wrote" in told
    assert "sample.checkpoint" in refused(f"sample.checkpoint={text}", "sample.generator=cat3d")
    assert "no generator 'seven'; installed are seva, cat3d" in refused("sample.generator=seven")
    strange = tmp_path / "strange.safetensors"
    save_model(strange, MultiViewModel(SIZES["tiny"]), {"sampler": {"steps": 3, "colour": "blue"}})
    assert "colour" in refused(f"sample.checkpoint={strange}")
    damaged = tmp_path / "damaged.safetensors"
    data = bytearray(model.read_bytes())
    data[-100] ^= 1
    damaged.write_bytes(bytes(data))
    with pytest.raises(InputError, match="sample.checkpoint: .* is damaged"):
        open_generator(job(tmp_path, f"sample.checkpoint={damaged}"))


def test_a_package_brings_its_own_and_workers_find_it(nearest_view: str, tmp_path: Path) -> None:
    """Sampled and decoded by two worker processes: every view is a copy of a photo, of the nearest one."""
    assert nearest_view in format_names()
    settings = [f"sample.generator={nearest_view}", "execution.workers=2"]
    one = job(tmp_path, *settings)
    records = run_stages(one, "ingest", "poses", "plan", "encode", "sample", "decode")
    assert records["sample"].work["workers"] == 2
    assert records["sample"].work["evaluations"] == 0
    run = run_of(one)
    images = run.generated.read("image")
    assert images.shape == (12, 32, 32, 3)
    squares = {image.tobytes() for image in _squares(one)}
    assert {image.tobytes() for image in images} <= squares
    assert len({image.tobytes() for image in images}) > 1


def _squares(one: Job) -> list[np.ndarray]:
    from flows.generation.views import captured_sample
    from flows.media.images import to_uint8
    from schemas.scene_store import SceneStore

    store = SceneStore.open(one.store_path)
    return [to_uint8(captured_sample(store, v, "square", 32).permute(1, 2, 0)) for v in range(9)]


def test_a_generator_that_wants_images_gets_photos_and_decoded_anchors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one photo: the anchors' group sees the photo, later groups also the anchors, as pictures."""
    code = code_of("own_generator.md").replace("nearest_view 1", "looks 1")
    code = code.replace("    cost=", '    wants=frozenset({"images"}),\n    cost=')
    code = code.replace(
        "for group in groups:", "for group in groups:\n            assert group.images.shape[0] == len(group.latents)"
    )
    code = code.replace("yield group.latents[", "yield 1 - group.images[")
    install(tmp_path / "site", monkeypatch, opening.GROUP, ("looks", "looks"), code)
    one = job(tmp_path, "sample.generator=looks", "execution.workers=1", split="1")
    run_stages(one, "ingest", "poses", "plan", "encode", "sample", "decode")
    images = run_of(one).generated.read("image")
    anchors = run_of(one).plan.read("anchor")
    photo = next(image for image in _squares(one) if np.abs(255 - image.astype(int) - images[anchors][0]).max() <= 1)
    for image in images[~anchors]:
        inverted = np.abs(255 - image.astype(int) - photo).max()
        again = np.abs(image.astype(int) - photo).max()
        assert min(inverted, again) <= 1, "the photo inverted, or an anchor (which is that) inverted"


def test_cost_of_the_shipped_generator_is_counted_without_it(tmp_path: Path) -> None:
    spec = generator_spec(job(tmp_path))
    cost = spec.cost(3, 5, spec.advice)
    assert cost.evaluations == 4
    assert cost.flops == pytest.approx(4 * core._flops.__wrapped__(_config().unet, 8))


def _config():  # type: ignore[no-untyped-def]
    from cat3d_core.diffusion import describe
    from cat3d_core.diffusion.config import ModelConfig, from_dict
    from cat3d_core.weights import default_model_path

    return from_dict(ModelConfig, describe(default_model_path())["config"])
