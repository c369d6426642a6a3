"""Every reader, and every kind of file that is read back, with damage by chance: no traceback, no hang, no flood of
memory. CAT3D_FUZZ_SECONDS says how long each test goes on, CAT3D_FUZZ_FIRST from which number."""

from __future__ import annotations

import json
import random
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cat3d_core.weights_file import read_weights
from flows.errors import InputError
from flows.generation.open import generator_spec, open_generator
from flows.jobs.metric_table import metric_table
from flows.jobs.scene import capture_digests
from flows.media.images import read_image, write_jpeg, write_png
from flows.readers import read_capture
from flows.reporting.inspect import inspect_store
from flows.stages.ingest import ingest_view
from schemas.config import IngestConfig, load_config
from schemas.documents import read_metadata, write_metadata
from schemas.errors import StoreError
from schemas.scene_store import SceneStore
from schemas.tables import append_rows, read_rows
from tests.flows.readers.conftest import _cameras
from tests.flows.readers.layouts import LAYOUTS
from tests.flows.workers.scene import random_model
from tests.reliability.fuzzing import damaged, numbers, refused, seconds
from tests.schemas.conftest import template  # noqa: F401

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Memory is bounded by /proc and rlimits.")
#: Seconds of the quick and of the slow variant of each test.
QUICK, LONG = 0.5, 20.0
TIMES = pytest.mark.parametrize(
    "quick", [QUICK, pytest.param(LONG, marks=[pytest.mark.slow, pytest.mark.timeout(1400)])], ids=["quick", "long"]
)


def _tree(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@TIMES
@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_a_damaged_scene_is_read_or_refused(layout: str, quick: float, tmp_path: Path) -> None:
    names = [f"{i:03d}.png" for i in range(4)]
    images = [np.full((48, 64, 3), 50 * i, np.uint8) for i in range(4)]
    path = LAYOUTS[layout](tmp_path / "scene", _cameras(4), images, names)
    files = _tree(tmp_path / "scene")
    described = [file for file in files if file.suffix != ".png"] or list(files)
    told = 0
    for number in numbers(seconds(quick) if quick == LONG else quick):
        rng = random.Random(f"{layout} {number}")
        for file in rng.sample(described, min(len(described), rng.choice((1, 1, 2)))):
            file.write_bytes(damaged(files[file], rng))
        try:
            told += refused(lambda: _use(path)) is not None
        except AssertionError as error:
            raise AssertionError(f"number {number} of {layout}: {error}") from None
        for file, data in files.items():
            if not file.exists() or file.read_bytes() != data:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
    assert told, "no damage was noticed"


def _use(path: Path) -> None:
    capture = read_capture(path)
    capture_digests(capture)
    ingest_view(capture, 0, IngestConfig())


@TIMES
@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_a_damaged_photo_is_read_or_refused(kind: str, quick: float, tmp_path: Path) -> None:
    path = tmp_path / f"photo.{kind}"
    noise = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    (write_png if kind == "png" else write_jpeg)(path, noise)
    _fuzz_file(path, quick, lambda: read_image(path))


@TIMES
def test_a_damaged_table_is_read_or_refused(quick: float, tmp_path: Path) -> None:
    row = {"scene_id": "a", "run": "v3", "key": "k", "protocol": "google", "view": 0, "width": 8, "height": 8}
    path = append_rows(tmp_path, metric_table(), [row | {"view": view} for view in range(20)], "a")
    _fuzz_file(path, quick, lambda: read_rows(tmp_path))


@TIMES
def test_a_damaged_model_is_opened_or_refused(quick: float, tmp_path: Path) -> None:
    from flows.jobs.request import Request, make_config

    path = random_model(tmp_path / "model.safetensors")
    settings = ["method=cat3d", f"sample.checkpoint={path}"]
    (job,) = Request(
        "procedural:dtu/3?views=4&width=16&height=12", tmp_path, ("3",), make_config({}, None, settings)
    ).jobs()
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")

    def use() -> None:
        generator_spec(job)
        try:
            read_weights(path)
        except ValueError as error:  # which those that open a model turn into the user's sentence
            raise InputError(str(error)) from None

    _fuzz_file(path, quick, use, lambda rng: damaged(data[:end], rng) + data[end:])
    path.write_bytes(data)
    open_generator(job)


@TIMES
def test_a_damaged_configuration_is_read_or_refused(quick: float, tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("method: cat3d\nplan: {views: 20, trajectory: auto}\nsample: {steps: 10, guidance: 3.0}\n")
    _fuzz_file(path, quick, lambda: load_config(path))


@TIMES
def test_damaged_files_of_a_store_are_found(template: Path, quick: float, tmp_path: Path) -> None:  # noqa: F811
    """Bytes of any file; and metadata that says other things under a good checksum, as someone could send it."""
    root = Path(shutil.copytree(template, tmp_path / "scene.zarr"))
    files = _tree(root)
    for number in numbers(seconds(quick) if quick == LONG else quick):
        rng = random.Random(number)
        file = rng.choice(list(files))
        try:
            if file.name == "zarr.json" and rng.random() < 0.7:
                _say_otherwise(file, rng)
            else:
                file.write_bytes(damaged(files[file], rng))
            refused(lambda: _look(root))
        except AssertionError as error:
            raise AssertionError(f"number {number}, {file.relative_to(root)}: {error}") from None
        file.write_bytes(files[file])


def _say_otherwise(file: Path, rng: random.Random) -> None:
    text = json.dumps(read_metadata(file.parent)).encode()
    for _ in range(20):
        try:
            document = json.loads(damaged(text, rng), parse_constant=lambda _: 0)
        except (ValueError, RecursionError):
            continue
        if isinstance(document, dict) and isinstance(document.get("attributes"), dict):
            write_metadata(file.parent, document)
            return


def _look(root: Path) -> None:
    inspect_store(root, verify_chunks=True)
    store = SceneStore.open(root)
    for section in (store.captured, store.latents, store.run("v3").generated, store.run("v3").renders("test")):
        for name in section.names():
            try:
                section.read(name)
            except StoreError:
                continue


def _fuzz_file(
    path: Path, quick: float, use: Callable[[], object], change: Callable[[random.Random], bytes] | None = None
) -> None:
    """Damage one file again and again."""
    data = path.read_bytes()
    told = 0
    for number in numbers(seconds(quick) if quick == LONG else quick):
        rng = random.Random(f"{path.name} {number}")
        path.write_bytes(change(rng) if change else damaged(data, rng))
        try:
            told += refused(use) is not None
        except AssertionError as error:
            raise AssertionError(f"number {number}: {error}") from None
    path.write_bytes(data)
    assert told, "no damage was noticed"
