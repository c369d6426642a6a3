"""Reconstructors by name: ours, an unknown one, bad settings; what the store keeps and how it is read again."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest
import torch

from cat3d_core.reconstruction import Reconstructor
from cat3d_core.zipnerf import ZipNerf
from flows.errors import InputError
from flows.jobs.access import read_cameras
from flows.jobs.job import Job
from flows.jobs.request import Request, make_config
from flows.media.images import to_uint8
from flows.reconstruction.open import open_reconstructor
from flows.reconstruction.stored import read_reconstruction
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from tests.flows.workers.scene import run_stages

SOURCE = "procedural:dtu/3?views=9&width=32&height=24"
SMALL = (
    "reconstruct.overrides={iterations: 6, batch_rays: 64, samples: [8, 8], grid_max: [32, 64], grid_features: [1, 2], \
interlevel_blur: [0.03], grid_log2_table: 10, warmup_iterations: 2}"
)


FIXTURE = Path(__file__).parents[2] / "fixtures" / "sweep_of_0888913.tar.gz"


def job(out: Path, *settings: str) -> Job:
    config = make_config({}, None, ["method=zipnerf", *settings])
    return Request(SOURCE, out, ("3",), config).jobs()[0]


def test_zipnerf_is_the_default_and_keeps_the_protocol(tmp_path: Path) -> None:
    reconstructor = open_reconstructor(job(tmp_path))
    assert isinstance(reconstructor, ZipNerf)
    wanted = {*vars(Reconstructor), *Reconstructor.__annotations__}
    assert not [name for name in wanted if not name.startswith("_") and name not in dir(reconstructor)]


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("reconstruct.method=slow", "reconstruct.method: there is no reconstructor 'slow'; installed are zipnerf"),
        ("reconstruct.preset=slow", "reconstruct.preset: 'slow' is none of zipnerf's; those are tiny, fast, balanced"),
        ("reconstruct.overrides={itarations: 3}", "reconstruct.overrides: itarations is not a setting of the trainer"),
        ("reconstruct.overrides={lr_final: 3}", "reconstruct.overrides: The learning rate falls"),
    ],
)
def test_a_bad_name_or_setting_is_refused_before_anything_runs(tmp_path: Path, setting: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        open_reconstructor(job(tmp_path, setting))
    assert sentence in str(error.value)


def test_an_unknown_solver_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="sample.solver: There is no solver 'euler'; choose one of ddim"):
        job(tmp_path, "sample.solver=euler")


def test_what_is_stored_renders_again_whatever_the_settings_of_today(tmp_path: Path) -> None:
    one = job(tmp_path, SMALL)
    run_stages(one, "ingest", "poses", "reconstruct")
    store = SceneStore.open(one.store_path, "r+")
    run = store.run(one.run)
    field = run.field
    assert field.attrs["method"] == "zipnerf"
    found = read_reconstruction(store, run)
    assert isinstance(found, ZipNerf)
    assert found.field.config.grid_max == (32, 64)
    for name, value in found.tensors().items():
        assert torch.equal(value, torch.from_numpy(field.read(name))), name
    field.set_attrs(method="gone")
    with pytest.raises(InputError, match="cannot be read: reconstruct.method: there is no reconstructor 'gone'"):
        read_reconstruction(store, run)
    field.set_attrs(method="zipnerf", settings={"trainer": {"depth_of_sea": 3}})
    with pytest.raises(InputError, match="another version of zipnerf and cannot be read .*depth_of_sea"):
        read_reconstruction(store, run)


def test_a_field_of_before_the_seam_shows_what_it_showed(tmp_path: Path) -> None:
    with tarfile.open(FIXTURE) as archive:
        archive.extractall(tmp_path, filter="data")
    path = next((tmp_path / "out").glob("*.zarr"))
    store = SceneStore.open(path)
    for name in store.runs():
        run = store.run(name)
        assert "method" not in run.field.attrs
        renders = run.renders("test")
        image = to_uint8(read_reconstruction(store, run).render(read_cameras(renders), 0).image)
        difference = image.astype(int) - renders.read_image("image", 0).astype(int)
        assert abs(difference).max() <= 1, "one level at most, on another processor"
