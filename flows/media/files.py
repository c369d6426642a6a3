"""Which files are images, and their headers: size, orientation, focal length (OpenImageIO; pillow-heif for HEIC)."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from flows.errors import InputError

MAX_PIXELS = 100_000_000
EXTENSIONS = frozenset(
    ["jpg", "jpeg", "jpe", "jfif", "jif", "jfi", "png", "webp", "tif", "tiff", "bmp", "dib", "exr", "hdr", "jp2"]
    + ["j2k", "j2c", "jph", "jxl", "ppm", "pgm", "pbm", "pnm", "pfm", "tga", "gif", "psd", "dds", "dpx"]
)
HEIF = frozenset(["heic", "heif", "hif", "avif"])
RAW = frozenset(["cr2", "cr3", "nef", "arw", "dng", "raf", "orf", "rw2", "pef", "srw"])
VIDEOS = frozenset(["mp4", "mov", "m4v", "avi", "mkv", "webm", "mts", "m2ts", "3gp", "wmv", "mpg", "mpeg"])
# First bytes of image files that came without an extension we know.
SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"GIF8", b"II*\0", b"MM\0*", b"\0\0\0\x0cjP  ", b"v/1\x01")
# Names that OpenImageIO opens as they are; in others it would look for options (?) or frame numbers (#, %).
SIMPLE_PATH = re.compile(r"[\w/. +,@=()~-]+")


def list_images(folder: Path) -> list[Path]:
    """Image files in sorted order: by extension (HEIC and RAW included so that they are named, not skipped), or by
    their first bytes where the extension says nothing. Hidden files are none."""
    files = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    return sorted(p for p in files if is_image(p))


def is_image(path: Path) -> bool:
    """Whether a file is an image, by its extension or its first bytes."""
    extension = path.suffix[1:].lower()
    if extension in EXTENSIONS | HEIF | RAW:
        return True
    return not _known_data(extension) and _signature(path)


def image_size(path: Path | str, max_pixels: int = MAX_PIXELS, upright: bool = True) -> tuple[int, int]:
    """(width, height) in pixels from the header alone, of the image turned upright by EXIF or as stored.

    Raises InputError as `images.read_image` does.
    """
    with opened(Path(path), max_pixels) as source:
        spec = source.spec()
        turned = upright and _orientation(spec) >= 5
        return (spec.height, spec.width) if turned else (spec.width, spec.height)


def orientation(path: Path | str) -> int:
    """The EXIF orientation, 1 (upright as stored) to 8."""
    with opened(Path(path), MAX_PIXELS) as source:
        return _orientation(source.spec())


def exif_focal_px(path: Path | str) -> float | None:
    """Focal length in pixels from EXIF's 35 mm equivalent (36 mm = the long side), None where it isn't recorded."""
    with opened(Path(path), MAX_PIXELS) as source:
        spec = source.spec()
        equivalent_mm = spec.get_float_attribute("Exif:FocalLengthIn35mmFilm", 0.0)
        return equivalent_mm / 36.0 * max(spec.width, spec.height) if equivalent_mm > 0 else None


@contextmanager
def opened(path: Path, max_pixels: int) -> Iterator[Any]:
    """An open OpenImageIO input (or `HeifFile`) whose header passed every check."""
    extension = path.suffix[1:].lower()
    if not path.is_file():
        raise InputError(f"Image file {path} does not exist.")
    if extension in RAW:
        raise InputError(f"{path} is a camera RAW file, which cannot be read here; convert it to JPEG or PNG.")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); copy it again or remove it.")
    with _simple_path(path) as simple:
        source = HeifFile(path) if extension in HEIF else _oiio_input(simple)
        if source is None:
            raise InputError(f"{path} is not an image that can be read ({first_line(oiio.geterror())}).")
        try:
            spec = source.spec()
            if spec.width * spec.height > max_pixels:
                raise InputError(
                    f"{path} has {spec.width} x {spec.height} pixels, more than the bound of {max_pixels / 1e6:g} "
                    "million; make it smaller first."
                )
            if "CMYK" in {spec.get_string_attribute(f"{f}:ColorSpace") for f in ("jpeg", "tiff")}:
                raise InputError(f"{path} is a CMYK image (made for printing); convert it to sRGB first.")
            yield source
        finally:
            source.close()


def first_line(error: str) -> str:
    """The first line of a library's error text."""
    return error.strip().splitlines()[0] if error.strip() else "no reason given"


class HeifFile:
    """A HEIC or AVIF file by pillow-heif (the extra `heic`), with the methods of an OpenImageIO input used here.

    libheif turns the picture upright itself, by the file's own transformations.
    """

    def __init__(self, path: Path) -> None:
        try:
            import pillow_heif
        except ImportError:
            raise InputError(
                f"{path} is a HEIC/AVIF file, which cannot be read here: install the reader for it "
                "(pip install 'cat3d[heic]') or convert it to JPEG or PNG."
            ) from None
        try:
            self._file = pillow_heif.open_heif(path.read_bytes(), convert_hdr_to_8bit=True)
        except Exception as error:  # libheif's errors have no common class
            raise InputError(f"{path} is not a HEIC/AVIF file that can be read ({first_line(str(error))}).") from None
        self._error = ""

    def spec(self) -> oiio.ImageSpec:
        """Size and channels; EXIF's focal length where it is recorded."""
        width, height = self._file.size
        spec = oiio.ImageSpec(int(width), int(height), len(self._file.mode), "uint8")
        spec.channelnames = tuple(self._file.mode)
        focal_mm = self._exif_focal_mm()
        if focal_mm:
            spec["Exif:FocalLengthIn35mmFilm"] = float(focal_mm)
        return spec

    def read_image(self, _format: str) -> np.ndarray | None:
        """(H, W, C) uint8; None where it cannot be decoded, and then `geterror` says why."""
        try:
            return np.asarray(self._file)
        except Exception as error:
            self._error = str(error)
            return None

    def geterror(self) -> str:
        return self._error

    def close(self) -> None:
        pass

    def _exif_focal_mm(self) -> float:
        from PIL import Image

        exif = Image.Exif()
        exif.load(self._file.info.get("exif") or b"")
        return float(exif.get_ifd(0x8769).get(0xA405, 0) or 0)


def _oiio_input(path: str) -> Any:
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    return oiio.ImageInput.open(path, config)


@contextmanager
def _simple_path(path: Path) -> Iterator[str]:
    """A path that OpenImageIO takes literally: the file's own, or a link to it in a temporary folder."""
    text = str(path)
    if SIMPLE_PATH.fullmatch(text) and text.isascii():
        yield text
        return
    with tempfile.TemporaryDirectory(prefix="cat3d-") as folder:
        suffix = path.suffix if re.fullmatch(r"\.[A-Za-z0-9]+", path.suffix) else ""
        link = Path(folder) / f"image{suffix}"
        link.symlink_to(path.resolve())
        yield str(link)


def _orientation(spec: Any) -> int:
    value = spec.get_int_attribute("Orientation", 1)
    return value if 1 <= value <= 8 else 1


def _known_data(extension: str) -> bool:
    return extension in VIDEOS or extension in ("txt", "json", "npy", "npz", "bin", "db", "camera", "ply", "md", "zip")


def _signature(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return False
    return head.startswith(SIGNATURES) or (head[:4] == b"RIFF" and head[8:12] == b"WEBP")
