"""What the loops and the fuzzing found: one test for each fault, so that none comes back."""

from __future__ import annotations

import gzip
import json
import math
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.errors import InputError
from flows.jobs.job import Job
from flows.media.images import write_jpeg, write_png
from flows.media.video import write_video
from flows.pipeline.runner import opened, prepare_run
from flows.readers import read_capture
from flows.readers.co3d import _annotated_frames
from flows.readers.llff import _table
from flows.readers.parsing import _same_aspect, cameras_for_files
from schemas import documents
from schemas.config import load_config
from schemas.documents import write_metadata
from schemas.errors import ConfigError
from schemas.scene_store import SceneStore
from schemas.verify import verify
from tests.flows.readers.conftest import _cameras
from tests.flows.readers.layouts import LAYOUTS
from tests.reliability.tiny import model, tiny_job


@contextmanager
def full_disk_after(size: int) -> Iterator[None]:
    """The system refuses to let any file grow beyond `size` bytes, for C libraries and child processes too."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


@pytest.mark.parametrize("write", [write_png, write_jpeg])
def test_a_picture_that_did_not_reach_the_disk_is_not_published(write, tmp_path: Path) -> None:
    """libpng and libjpeg pass over writes that fail: a full disk left damaged pictures, and the run was complete."""
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    path = tmp_path / ("a.png" if write is write_png else "a.jpg")
    write(path, noise)
    good = path.read_bytes()
    for size in (len(good) // 2, len(good) - 10):
        with full_disk_after(size), pytest.raises(InputError, match=r"a\.(png|jpg) cannot be written"):
            write(path, noise)
        assert path.read_bytes() == good
        assert list(tmp_path.iterdir()) == [path]


def test_a_video_that_did_not_reach_the_disk_is_not_published(tmp_path: Path) -> None:
    """ffmpeg's exit code was not looked at."""
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    assert write_video(tmp_path / "a.mp4", frames) == 3
    good = (tmp_path / "a.mp4").read_bytes()
    with full_disk_after(len(good) // 2), pytest.raises((InputError, OSError)):
        write_video(tmp_path / "a.mp4", frames)
    assert (tmp_path / "a.mp4").read_bytes() == good


def test_a_folder_whose_document_could_not_be_written_is_not_left(tmp_path: Path, monkeypatch) -> None:
    """It was an orphan to `inspect --verify` until the stage ran again."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(documents.os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write_metadata(tmp_path / "group", {"zarr_format": 3, "node_type": "group", "attributes": {}})
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def prepared(tmp_path: Path) -> Job:
    job = tiny_job(tmp_path / "out", model(tmp_path))
    with opened(job):
        prepare_run(job)
    return job


@pytest.mark.parametrize("name", ["zarr.json", "c.0"])
def test_damaged_roles_are_written_again(prepared: Job, name: str) -> None:
    """No stage writes them, so a run that found them damaged could never go on."""
    run = SceneStore.open(prepared.store_path).run(prepared.run)
    before = run.read("role")
    file = run.folder / "role" / name
    assert file.exists()
    file.write_bytes(b"")
    with opened(prepared):
        prepare_run(prepared)
    assert np.array_equal(run.read("role"), before)
    assert list(verify(SceneStore.open(prepared.store_path))) == []


def test_a_removed_record_does_not_come_back_after_a_power_cut(prepared: Job, monkeypatch) -> None:
    """The folder above was not synced: an old record could have been found with the data of a new run."""
    synced: list[Path] = []
    monkeypatch.setattr(documents, "sync_folder", synced.append)
    store = SceneStore.open(prepared.store_path, "r+")
    documents.write_group(store.folder / "stages" / "ingest", {})
    synced.clear()
    assert store.forget("ingest")
    assert synced == [store.folder / "stages"]


def test_damage_inside_a_gzip_file(tmp_path: Path) -> None:
    """zlib's own error, which is no OSError."""
    path = tmp_path / "frame_annotations.jgz"
    data = bytearray(gzip.compress(json.dumps([{"sequence_name": "a"} for _ in range(50)]).encode()))
    for position in range(10, len(data) - 8):
        bad = bytearray(data)
        bad[position] ^= 0xFF
        path.write_bytes(bad)
        with pytest.raises(InputError, match=r"jgz"):
            _annotated_frames(path, "b")


def test_an_array_whose_header_ends_in_the_middle(tmp_path: Path) -> None:
    """Python's tokenizer has errors of its own."""
    path = tmp_path / "poses_bounds.npy"
    np.save(path, np.zeros((3, 17)))
    data = path.read_bytes()
    path.write_bytes(data.replace(b"(3, 17)", b"(((((((", 1))
    with pytest.raises(InputError, match="cannot be read as a plain NumPy array"):
        _table(path)


def test_a_method_that_is_no_word(tmp_path: Path) -> None:
    (tmp_path / "run.yaml").write_text("method: [zipnerf, cat3d]\n")
    with pytest.raises(ConfigError, match="method is"):
        load_config(tmp_path / "run.yaml")


def test_packages_that_nobody_knows_are_not_said_to_be_without_vulnerabilities() -> None:
    """pip-audit ends with "No known vulnerabilities found" where a mirror knows none of the packages."""
    from infra.audit import verdict

    known = {"name": "a", "version": "1", "vulns": []}
    bad = {"name": "b", "version": "2", "vulns": [{"id": "CVE-1", "fix_versions": ["3"]}]}
    unknown = {"name": "c", "skip_reason": "Dependency not found on PyPI"}
    assert verdict({"dependencies": [known]}) == (["1 of 1 pinned packages were looked up."], 0)
    lines, code = verdict({"dependencies": [known, bad, unknown]})
    assert code == 1
    assert lines[0] == "b 2: CVE-1, mended in 3"
    assert lines[1:] == ["2 of 3 pinned packages were looked up.", "Nothing is known of c."]


def test_sizes_of_almost_nothing_and_without_end(tmp_path: Path) -> None:
    """A size that underflows when it is divided by, one that is infinite, and a time that is."""
    assert not _same_aspect(64, 48, 1e-320, 48)
    size = torch.tensor([[math.inf, 48.0]])
    with pytest.raises(InputError, match="both must be positive"):
        cameras_for_files(torch.eye(3)[None], size, torch.eye(4)[None], [tmp_path], ["a"], tmp_path, [])
    pixels = [np.zeros((48, 64, 3), np.uint8)] * 2
    path = LAYOUTS["realestate10k"](tmp_path / "scene", _cameras(2), pixels, ["1.png", "2.png"])
    (listed,) = (tmp_path / "scene").rglob("*.txt")
    lines = listed.read_text().splitlines()
    listed.write_text("\n".join([*lines[:-1], "1e999 " + lines[-1].partition(" ")[2]]))
    with pytest.raises(InputError, match="no finite number"):
        read_capture(path)
