"""Image files in and out, resizing and undistortion, and what is said about files that can't be used."""

from __future__ import annotations

import math
import struct
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from cat3d_core.cameras import Cameras
from flows.errors import InputError
from flows.media.files import exif_focal_px, image_size, list_images
from flows.media.images import (
    read_image,
    read_mask,
    resize,
    to_uint8,
    undistort,
    write_jpeg,
    write_png,
)
from flows.media.lens import distort
from flows.media.video import write_video


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)


def _write_oiio(path, array: np.ndarray, kind: str, **attributes) -> None:
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], kind)
    for key, value in attributes.items():
        spec[key.replace("__", ":")] = value
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(np.ascontiguousarray(array))
    assert out.close()


def _png_of_claimed_size(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = b"\x89PNG\r\n\x1a\n"
    for kind, content in ((b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 1000)), (b"IEND", b"")):
        body += struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    return body


@pytest.mark.parametrize("extension", ["png", "webp", "bmp", "tif", "ppm"])
def test_lossless_formats_read_back(tmp_path, pixels, extension):
    path = tmp_path / f"a.{extension}"
    Image.fromarray(pixels).save(path, **({"lossless": True} if extension == "webp" else {}))
    image, alpha = read_image(path)
    assert alpha is None
    np.testing.assert_array_equal(image, pixels)
    assert image_size(path) == (40, 30)


def test_jpeg_equals_pillow(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    reference = np.array(Image.open(tmp_path / "a.jpg")).astype(int)
    assert np.abs(read_image(tmp_path / "a.jpg")[0] - reference).max() <= 1


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_honoured(tmp_path, pixels, orientation):
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[0x112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    upright = np.array(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0], upright)
    assert image_size(tmp_path / "a.png") == upright.shape[1::-1]


def test_sixteen_bits_grey_and_palette(tmp_path, pixels):
    _write_oiio(tmp_path / "a.png", pixels.astype(np.uint16) * 257, "uint16")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0], pixels)
    Image.fromarray(pixels[..., 0]).save(tmp_path / "g.png")
    np.testing.assert_array_equal(read_image(tmp_path / "g.png")[0], pixels[..., :1].repeat(3, -1))
    palette = Image.fromarray(pixels).quantize(16)
    palette.save(tmp_path / "p.png")
    np.testing.assert_array_equal(read_image(tmp_path / "p.png")[0], np.array(palette.convert("RGB")))


@pytest.mark.parametrize(("extension", "kind"), [("exr", "half"), ("exr", "float"), ("hdr", "float")])
def test_linear_floats_become_srgb(tmp_path, extension, kind):
    linear = np.linspace(0, 1.5, 60, dtype=np.float32).reshape(4, 5, 3)
    _write_oiio(tmp_path / f"a.{extension}", linear, kind)
    x = np.clip(linear.astype(float), 0, 1)
    expected = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055) * 255
    # Radiance's shared exponent has 8 bits: up to 3 levels near black.
    assert np.abs(read_image(tmp_path / f"a.{extension}")[0] - expected).max() <= (8 if extension == "hdr" else 0.6)


def test_alpha_is_composited_or_kept(tmp_path, pixels):
    alpha = np.random.default_rng(1).integers(0, 256, (30, 40), dtype=np.uint8)
    Image.fromarray(np.dstack([pixels, alpha]), "RGBA").save(tmp_path / "a.png")
    image, found = read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(found, alpha)
    weight = alpha[..., None] / 255
    assert np.abs(image - (pixels * weight + 255 * (1 - weight))).max() <= 0.51
    raw, _ = read_image(tmp_path / "a.png", background=None)
    np.testing.assert_array_equal(raw, pixels)
    black, _ = read_image(tmp_path / "a.png", background=0.0)
    assert np.abs(black - pixels * weight).max() <= 0.51


def test_written_files_read_back(tmp_path, pixels):
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0], pixels)
    rgba = np.dstack([pixels, pixels[..., 0]])
    write_png(tmp_path / "b.png", rgba)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "b.png")), rgba)
    write_png(tmp_path / "c.png", torch.from_numpy(pixels[..., 0].astype(np.float32) / 255))
    np.testing.assert_array_equal(read_image(tmp_path / "c.png")[0][..., 0], pixels[..., 0])
    smooth = np.tile(np.linspace(0, 255, 40)[None, :, None], (30, 1, 3)).astype(np.uint8)
    write_jpeg(tmp_path / "d.jpg", smooth)
    assert np.abs(read_image(tmp_path / "d.jpg")[0].astype(int) - smooth).max() <= 6
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_mask_and_listing(tmp_path):
    mask = np.zeros((4, 4), np.uint8)
    mask[1, 2], mask[2, 2] = 200, 100
    write_png(tmp_path / "m.png", mask)
    assert read_mask(tmp_path / "m.png").nonzero() == (np.array([1]), np.array([2]))
    (tmp_path / "x.txt").write_text("")
    (tmp_path / ".hidden.png").write_text("")
    assert [p.name for p in list_images(tmp_path)] == ["m.png"]


def test_exif_focal_length(tmp_path, pixels):
    _write_oiio(tmp_path / "a.jpg", pixels, "uint8", Exif__FocalLengthIn35mmFilm=26)
    assert exif_focal_px(tmp_path / "a.jpg") == pytest.approx(26 / 36 * 40)
    write_png(tmp_path / "b.png", pixels)
    assert exif_focal_px(tmp_path / "b.png") is None


def _bad_files(folder, pixels) -> dict[str, tuple[str, str]]:
    """{case: (file name, what must be said)}."""
    Image.fromarray(np.tile(pixels, (20, 20, 1))).save(folder / "whole.jpg", quality=90)
    whole = (folder / "whole.jpg").read_bytes()
    (folder / "truncated.jpg").write_bytes(whole[: len(whole) // 2])
    Image.fromarray(np.tile(pixels, (20, 20, 1))).save(folder / "whole.png")
    whole = (folder / "whole.png").read_bytes()
    (folder / "truncated.png").write_bytes(whole[: len(whole) // 2])
    (folder / "zero.png").write_bytes(b"")
    (folder / "text.jpg").write_text("not a picture")
    (folder / "bomb.png").write_bytes(_png_of_claimed_size(60000, 60000))
    (folder / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic")
    (folder / "camera.CR2").write_bytes(b"II*\0")
    Image.fromarray(np.dstack([pixels, pixels[..., 0]]), "CMYK").save(folder / "print.jpg")
    nan = np.full((4, 4, 3), np.nan, np.float32)
    _write_oiio(folder / "nan.exr", nan, "float")
    return {
        "missing": ("none.png", "does not exist"),
        "truncated jpeg": ("truncated.jpg", "damaged or incomplete"),
        "truncated png": ("truncated.png", "damaged or incomplete"),
        "zero bytes": ("zero.png", "is empty (0 bytes)"),
        "text": ("text.jpg", "is not an image that can be read"),
        "bomb": ("bomb.png", "claims a 10299 MB image"),
        "heic": ("phone.heic", "HEIC/AVIF file"),
        "raw": ("camera.CR2", "camera RAW file"),
        "cmyk": ("print.jpg", "CMYK image"),
        "nan": ("nan.exr", "NaN or infinite pixels"),
    }


def test_bad_files_are_named_with_the_reason(tmp_path, pixels):
    for what, (name, message) in _bad_files(tmp_path, pixels).items():
        with pytest.raises(InputError) as caught:
            read_image(tmp_path / name)
        assert message in str(caught.value), (what, str(caught.value))
        assert name in str(caught.value)


def test_bound_on_pixels_holds_for_headers_too(tmp_path, pixels):
    write_png(tmp_path / "a.png", pixels)
    with pytest.raises(InputError, match="40 x 30 pixels, more than the bound"):
        image_size(tmp_path / "a.png", max_pixels=1199)
    assert read_image(tmp_path / "a.png", max_pixels=1200)[0].shape == (30, 40, 3)


@given(st.integers(1, 50), st.integers(1, 50))
def test_resize_keeps_a_constant_and_the_asked_size(width, height):
    image = np.full((17, 23, 3), 77, np.uint8)
    out = resize(image, width, height)
    assert out.shape == (height, width, 3)
    assert (out == 77).all()


@given(st.floats(0.25, 1.0))
def test_resize_moves_a_blob_as_the_cameras_do(factor):
    """The centroid of a blob lands where `Cameras.resize` says, to a fiftieth of a pixel."""
    y, x = np.mgrid[:80, :120] + 0.5
    blob = 255 * np.exp(-((x - 70.3) ** 2 + (y - 33.1) ** 2) / (2 * 8.0**2))
    width, height = round(120 * factor), round(80 * factor)
    out = resize(blob.round().astype(np.uint8), width, height).astype(float)
    rows, columns = np.mgrid[:height, :width] + 0.5
    found = np.array([(out * columns).sum(), (out * rows).sum()]) / out.sum()
    k = torch.tensor([[[100.0, 0, 70.3], [0, 100, 33.1], [0, 0, 1]]], dtype=torch.float64)
    camera = Cameras(k, torch.eye(4, dtype=torch.float64)[None], torch.tensor([[120, 80]])).resize(width, height)
    np.testing.assert_allclose(found, camera.intrinsics[0, :2, 2].numpy(), atol=0.05)


def test_resize_shrinks_without_aliasing(pixels):
    stripes = np.zeros((64, 64), np.uint8)
    stripes[:, ::2] = 255
    assert np.abs(resize(stripes, 16, 16)[:, 2:-2].astype(int) - 128).max() <= 2


def test_distort_matches_opencv_formula_written_out():
    k = torch.tensor([0.1, -0.05, 0.01, -0.02, 0.03], dtype=torch.float64)
    x, y = 0.4, -0.3
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 - 0.05 * r2**2 + 0.03 * r2**3
    expected = [
        x * radial + 2 * 0.01 * x * y - 0.02 * (r2 + 2 * x * x),
        y * radial + 0.01 * (r2 + 2 * y * y) - 2 * 0.02 * x * y,
    ]
    assert distort(torch.tensor([x, y], dtype=torch.float64), k).tolist() == pytest.approx(expected, abs=1e-15)


K = torch.tensor([[90.0, 0, 62.0], [0, 88, 41.0], [0, 0, 1]], dtype=torch.float64)


def _scene(xy: torch.Tensor) -> torch.Tensor:
    """A smooth pattern on the plane at distance 1, in [0, 255]."""
    return 127 + 60 * torch.sin(9 * xy[..., 0]) + 60 * torch.cos(7 * xy[..., 1])


def _rays(k: torch.Tensor, width: int, height: int) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixel = torch.stack([columns, rows], -1).double()
    return (pixel - k[:2, 2]) / torch.stack([k[0, 0], k[1, 1]])


@settings(max_examples=15)
@given(st.floats(-0.25, 0.25), st.floats(-0.1, 0.1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_undistort_makes_the_pinhole_image(k1, k2, p1, p2):
    """A photo made through the lens, undistorted, equals the pattern seen by the pinhole camera it returns."""
    lens = torch.tensor([k1, k2, p1, p2, 0.0], dtype=torch.float64)
    distorted = _rays(K, 120, 80)
    xy = distorted.clone()
    for _ in range(100):  # invert the lens by fixed point
        xy = xy + (distorted - distort(xy, lens))
    photo = _scene(xy).round().to(torch.uint8).numpy()
    out, k = undistort(photo, K, lens)
    expected = _scene(_rays(k, 120, 80)).numpy()
    assert out.shape == photo.shape
    assert np.abs(out[2:-2, 2:-2] - expected[2:-2, 2:-2]).max() < 3.0
    torch.testing.assert_close(k[:2, 2], K[:2, 2])


def test_undistort_leaves_no_border_and_keeps_the_view():
    lens = torch.tensor([0.0578421, -0.0805099, -0.000980296, 0.00015575, 0.0], dtype=torch.float64)  # the fox's phone
    k = torch.tensor([[722.1, 0, 291.1], [0, 721.6, 506.8], [0, 0, 1]], dtype=torch.float64)
    out, new = undistort(np.full((1008, 567, 3), 200, np.uint8), k, lens)
    assert (out == 200).all()
    assert 0.97 < new[0, 0] / k[0, 0] < 1.03
    same, unchanged = undistort(out, k, torch.zeros(5))
    assert same is out
    assert torch.equal(unchanged, k)


def test_undistort_refuses_implausible_coefficients():
    with pytest.raises(InputError, match="implausible"):
        undistort(np.zeros((80, 120, 3), np.uint8), K, torch.tensor([-40.0, 0, 0, 0, 0]))


def test_video_plays_back(tmp_path):
    frames = [np.full((33, 47, 3), 20 * i, np.uint8) for i in range(10)]
    assert write_video(tmp_path / "v.mp4", frames, fps=10) == 10
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(tmp_path / "v.mp4"))
    meta = next(reader)
    assert meta["size"] == (46, 32)
    assert meta["pix_fmt"].startswith("yuv420p")
    levels = [np.frombuffer(f, np.uint8).mean() for f in reader]
    np.testing.assert_allclose(levels, np.arange(10) * 20, atol=4)


def test_video_of_no_or_unequal_frames_is_refused(tmp_path):
    with pytest.raises(InputError, match="no frames"):
        write_video(tmp_path / "v.mp4", [])
    with pytest.raises(InputError, match="Frame 1"):
        write_video(tmp_path / "v.mp4", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)])
    assert list(tmp_path.iterdir()) == []


def test_to_uint8_rounds_and_clips():
    assert to_uint8(np.array([-1.0, 0.0, 0.5 / 255 + 1e-6, 1.0, 2.0])).tolist() == [0, 0, 1, 255, 255]
    assert math.isclose(to_uint8(torch.tensor([0.25])).item(), 64)
