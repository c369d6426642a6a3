"""Splat files: re-read by us and by packages that are not ours, their axes checked by rendering."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.quaternions import rotation_matrices
from cat3d_core.splats.gaussians import Gaussians
from cat3d_core.splats.rasterize import rasterize
from flows.errors import InputError
from flows.exports.splat_files import (
    READERS,
    WRITERS,
    read_ply,
    read_splat,
    read_spz,
    write_ply,
    write_splat,
    write_spz,
)
from tests.core.splats.scenes import camera, gaussians

DEGREES = [0, 1, 2]


def some(degree: int = 0) -> Gaussians:
    g = gaussians(200, degree=degree).to(dtype=torch.float32)
    harmonics = g.harmonics.clone()
    harmonics[:, 0] *= 0.5  # colours that 8 bits can say
    harmonics[:, 1:] *= 0.2
    return Gaussians(g.means, g.quaternions, g.log_scales, g.logits, harmonics)


def unit(quaternions: torch.Tensor) -> torch.Tensor:
    q = torch.nn.functional.normalize(quaternions.float(), dim=-1)
    return torch.where(q.gather(1, q.abs().argmax(1, keepdim=True)) < 0, -q, q)


@pytest.mark.parametrize("degree", DEGREES)
def test_ply_keeps_every_bit(tmp_path: Path, degree: int) -> None:
    g, path = some(degree), tmp_path / "a.ply"
    write_ply(path, g)
    back = read_ply(path)
    for name in ("means", "log_scales", "logits", "harmonics"):
        assert torch.equal(getattr(back, name), getattr(g, name)), name
    torch.testing.assert_close(unit(back.quaternions), unit(g.quaternions))


@pytest.mark.parametrize("degree", DEGREES)
def test_plyfile_reads_the_same_numbers(tmp_path: Path, degree: int) -> None:
    """By the names that viewers look for."""
    plyfile = pytest.importorskip("plyfile")
    g, path = some(degree), tmp_path / "a.ply"
    write_ply(path, g)
    vertex = plyfile.PlyData.read(str(path))["vertex"]

    def columns(name: str, count: int) -> np.ndarray:
        return np.stack([vertex[f"{name}_{i}"] for i in range(count)], 1)

    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], 1), g.means.numpy())
    assert np.array_equal(columns("scale", 3), g.log_scales.numpy())
    assert np.array_equal(vertex["opacity"], g.logits.numpy())
    assert np.array_equal(columns("f_dc", 3), g.harmonics[:, 0].numpy())
    rest = (degree + 1) ** 2 - 1
    if rest:  # of each channel all coefficients, then the next channel
        assert np.array_equal(
            columns("f_rest", 3 * rest).reshape(-1, 3, rest), g.harmonics[:, 1:].transpose(1, 2).numpy()
        )
    rotation = torch.from_numpy(columns("rot", 4))
    torch.testing.assert_close(unit(rotation), unit(g.quaternions))


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_gsply_reads_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    """gsply leaves axes as the file has them: those of a .spz are turned by half round x."""
    gsply = pytest.importorskip("gsply")
    g, path = some(), tmp_path / f"a{suffix}"
    WRITERS[suffix](path, g)
    read = gsply.plyread(str(path)) if suffix == ".ply" else gsply.read_spz(str(path))
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])) if suffix == ".spz" else torch.eye(3)
    torch.testing.assert_close(torch.from_numpy(read.means), g.means @ turn, rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.from_numpy(read.scales), g.log_scales, rtol=0, atol=0.0321)
    opacities = torch.from_numpy(read.opacities).reshape(-1).sigmoid()
    torch.testing.assert_close(opacities, g.opacities, rtol=0, atol=0.0021)
    torch.testing.assert_close(torch.from_numpy(read.sh0).reshape(-1, 3), g.harmonics[:, 0], rtol=0, atol=0.0141)
    rotations = rotation_matrices(torch.from_numpy(read.quats))
    torch.testing.assert_close(rotations, turn @ g.rotations, rtol=0, atol=0.01)


@pytest.mark.parametrize("suffix", [".splat", ".spz"])
def test_gaussforge_reads_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    """It rewrites a file as .ply, in the file's own order, and leaves axes as the file has them."""
    gaussforge = pytest.importorskip("gaussforge")
    path = tmp_path / f"a{suffix}"
    WRITERS[suffix](path, some())
    found = gaussforge.GaussForge().convert(path.read_bytes(), suffix[1:], "ply")
    (tmp_path / "read.ply").write_bytes(found["data"])
    theirs, ours = read_ply(tmp_path / "read.ply"), READERS[suffix](path)
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])) if suffix == ".spz" else torch.eye(3)
    torch.testing.assert_close(theirs.means, ours.means @ turn, rtol=0, atol=0)
    torch.testing.assert_close(theirs.log_scales, ours.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(theirs.opacities, ours.opacities, rtol=0, atol=1e-6)
    torch.testing.assert_close(theirs.harmonics, ours.harmonics, rtol=0, atol=1e-6)
    torch.testing.assert_close(theirs.rotations, turn @ ours.rotations, rtol=0, atol=2e-6)


@pytest.mark.parametrize("degree", DEGREES)
def test_spz_keeps_what_its_bits_can_say(tmp_path: Path, degree: int) -> None:
    g, path = some(degree), tmp_path / "a.spz"
    write_spz(path, g)
    back = read_spz(path)
    torch.testing.assert_close(back.means, g.means, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.log_scales, g.log_scales, rtol=0, atol=1 / 32 + 1e-6)
    torch.testing.assert_close(back.opacities, g.opacities, rtol=0, atol=0.5 / 255 + 1e-6)
    torch.testing.assert_close(back.harmonics[:, 0], g.harmonics[:, 0], rtol=0, atol=0.5 / 255 / 0.15 + 1e-6)
    torch.testing.assert_close(back.harmonics[:, 1:], g.harmonics[:, 1:], rtol=0, atol=8 / 128 + 1e-3)
    torch.testing.assert_close(unit(back.quaternions), unit(g.quaternions), rtol=0, atol=0.004)


def test_splat_is_sorted_and_keeps_what_8_bits_can_say(tmp_path: Path) -> None:
    g, path = some(), tmp_path / "a.splat"
    write_splat(path, g)
    order = (g.scales.prod(1) * g.opacities).argsort(descending=True)
    assert path.stat().st_size == 32 * len(g)
    back, g = read_splat(path), g[order]
    torch.testing.assert_close(back.means, g.means, rtol=0, atol=0)
    torch.testing.assert_close(back.scales, g.scales)
    torch.testing.assert_close(back.opacities, g.opacities, rtol=0, atol=1.01 / 255)
    centre = torch.zeros(3)
    torch.testing.assert_close(back.colours(centre), g.colours(centre).clamp(0, 1), rtol=0, atol=0.51 / 255)
    error = (unit(back.quaternions) - unit(g.quaternions)).abs().amax(1)
    assert float(error.max()) < 0.02


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_what_a_file_says_looks_like_what_was_written(tmp_path: Path, suffix: str) -> None:
    """The axes, by rendering."""
    g, path = some(), tmp_path / f"a{suffix}"
    WRITERS[suffix](path, g)
    c = camera()
    wanted, found = rasterize(g, c), rasterize(READERS[suffix](path), c)
    error = (wanted.features - found.features).square().mean()
    assert -10 * math.log10(float(error) + 1e-12) > 38


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    WRITERS[suffix](path, some())
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match="a\\" + suffix):
        READERS[suffix](path)
    path.write_bytes(b"something else")
    with pytest.raises(InputError, match="a\\" + suffix):
        READERS[suffix](path)


def test_other_ply_and_spz_files_are_refused(tmp_path: Path) -> None:
    from flows.exports.ply import write_ply as write_points

    points = np.zeros((3, 3), np.float32)
    write_points(tmp_path / "points.ply", points, points, points.astype(np.uint8))
    with pytest.raises(InputError, match="not a .ply of 3D Gaussian splatting"):
        read_ply(tmp_path / "points.ply")
    write_spz(tmp_path / "a.spz", some())
    raw = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    raw[4] = 2
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(raw)))
    with pytest.raises(InputError, match="not a .spz of version 3"):
        read_spz(tmp_path / "a.spz")


def test_spz_refuses_what_it_cannot_say(tmp_path: Path) -> None:
    g = some()
    huge = Gaussians(g.means, g.quaternions, g.log_scales + 12, g.logits, g.harmonics)
    with pytest.raises(InputError, match="Choose the frame `scene`"):
        write_spz(tmp_path / "a.spz", huge)
    far = Gaussians(g.means * 1e7, g.quaternions, g.log_scales, g.logits, g.harmonics)
    with pytest.raises(InputError, match="positions reach"):
        write_spz(tmp_path / "a.spz", far)
    assert not list(tmp_path.iterdir())
