"""Small files that stand for a flood of memory: each is refused with a sentence before it is made."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cat3d_core.weights_file import read_weights
from flows.errors import InputError
from flows.media import packed
from flows.media.images import read_image
from flows.readers.parsing import load_arrays, load_json
from flows.readers.procedural import read as read_procedural
from schemas import arrays
from schemas.config import load_config
from schemas.documents import read_metadata, write_metadata
from schemas.errors import ConfigError, StoreError
from schemas.tables import read_rows
from tests.reliability.fuzzing import bounded
from tests.schemas.conftest import template  # noqa: F401


@pytest.fixture(autouse=True)
def _memory() -> None:
    with bounded():
        yield


def png(path: Path, width: int, height: int) -> Path:
    """A PNG whose header says this size, with a row or two of data."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(1000))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b""))
    return path


def test_an_image_of_60000_by_60000_pixels(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="60000 x 60000 pixels, more than the bound|header claims a 10299 MB image"):
        read_image(png(tmp_path / "bomb.png", 60_000, 60_000))
    with pytest.raises(InputError, match=r"bomb\.png"):  # within the bound, and its pixels are not there
        read_image(png(tmp_path / "bomb.png", 9_000, 9_000))


def test_a_gzip_file_that_unpacks_to_more_than_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed, "MAX_BYTES", 1_000_000)
    (tmp_path / "frame_annotations.jgz").write_bytes(gzip.compress(bytes(2_000_000)))
    with pytest.raises(InputError, match="unpacks to more than"):
        packed.gunzip(tmp_path / "frame_annotations.jgz")


def test_members_of_a_zip_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed, "MAX_BYTES", 1_000_000)
    np.savez_compressed(tmp_path / "gt_cameras.npz", a=np.zeros(1_000_000))
    with pytest.raises(InputError, match="unpacks to 0.0 GB, more than the bound"):
        load_arrays(tmp_path / "gt_cameras.npz", ["a"])


def test_an_array_of_numpy_whose_header_says_too_much(tmp_path: Path) -> None:
    header = str({"descr": "<f8", "fortran_order": False, "shape": (10**12, 17)}).encode().ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header)
    with pytest.raises(InputError, match="cannot be read as a NumPy archive"):
        load_arrays(tmp_path / "a.npz", ["a"])


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a":' * 100_000, "9" * 5_000])
def test_json_that_is_nested_or_long_without_end(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match=r"transforms\.json"):
        load_json(tmp_path / "transforms.json")
    (tmp_path / "zarr.json").write_text(text)
    with pytest.raises(StoreError, match=r"zarr\.json is damaged"):
        read_metadata(tmp_path)


def test_yaml_whose_aliases_multiply(tmp_path: Path) -> None:
    """The "billion laughs": ten levels, each ten times the one below."""
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    (tmp_path / "run.yaml").write_text("\n".join(levels) + "\nmethod: *a9\n")
    with pytest.raises(ConfigError, match=r"run\.yaml"):
        load_config(tmp_path / "run.yaml")


def test_a_table_of_endless_equal_rows(tmp_path: Path) -> None:
    table = pa.table({"a": pa.DictionaryArray.from_arrays(pa.array(np.zeros(11_000_000, np.int8)), ["x" * 1000])})
    pq.write_table(table, tmp_path / "a.parquet", compression="zstd")
    assert (tmp_path / "a.parquet").stat().st_size < 2_000_000
    with pytest.raises(StoreError, match="11000000 rows"):
        read_rows(tmp_path)


@pytest.mark.parametrize(
    ("shape", "chunks"),
    [((10**12, 3, 3), (1, 3, 3)), ((3, 10**6, 10**6), (1, 10**6, 10**6)), ((10**15,), (10**6,)), ((2**62, 4), (1, 4))],
)
def test_metadata_of_zarr_that_say_too_much(
    template: Path,  # noqa: F811
    tmp_path: Path,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
) -> None:
    folder = Path(shutil.copytree(template / "captured" / "world_from_camera", tmp_path / "array"))
    document = read_metadata(folder) | {"shape": list(shape), "dimension_names": None}
    document["chunk_grid"] = {"name": "regular", "configuration": {"chunk_shape": list(chunks)}}
    write_metadata(folder, document)
    with pytest.raises(StoreError, match="none of ours has"):
        arrays.read(folder)


def test_the_header_of_a_safetensors_file(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    for header in ({"w": {"dtype": "F32", "shape": [10**9, 10**9], "data_offsets": [0, 4 * 10**18]}},
                   {"w": {"dtype": "F32", "shape": [1], "data_offsets": [0, 10**12]}}):  # fmt: skip
        text = json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + bytes(16))
        with pytest.raises(ValueError, match="not a readable safetensors file"):
            read_weights(path)
    path.write_bytes(struct.pack("<Q", 2**63) + b"{}")
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        read_weights(path)


def test_a_procedural_scene_of_too_many_pixels() -> None:
    with pytest.raises(InputError):
        read_procedural("procedural:llff/3?views=100000&width=100000&height=100000", None, (3,))
