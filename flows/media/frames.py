"""Frames of a video, by the ffmpeg that imageio-ffmpeg brings: the sharpest of each of equal stretches of time."""

from __future__ import annotations

import atexit
import re
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import imageio_ffmpeg
import numpy as np

from flows.errors import InputError
from flows.media.images import read_image

#: Raise when other frames would be chosen: they are known by the video's digest and this, not by their pixels.
VERSION = 1
# Frames looked at in each stretch, and the width at which their sharpness is compared.
TRIED = 8
SHARPNESS_WIDTH = 480


def video_length(path: Path) -> tuple[float, float]:
    """(seconds, frames a second) of a video, by its header. Raises InputError for a file that is no video."""
    probe = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", f"file:{path}"], capture_output=True)
    text = probe.stderr.decode("utf-8", "replace")
    length = re.search(r"Duration: (\d+):(\d+):([\d.]+)", text)
    rate = re.search(r"Video:.*?([\d.]+)(k?) (?:fps|tbr)", text)
    if not length or not rate:
        raise InputError(f"{path} is not a video that ffmpeg can read; convert it to mp4, or give frames as photos.")
    hours, minutes, seconds = (float(g) for g in length.groups())
    return 3600 * hours + 60 * minutes + seconds, float(rate.group(1)) * (1000 if rate.group(2) else 1)


class VideoFrames(Sequence[np.ndarray]):
    """`count` frames (H, W, 3) uint8, turned upright by the video's own mark; on disk from the first use on.

    Raises InputError when there are fewer frames than asked for, or the video breaks off.
    """

    def __init__(self, path: Path, count: int, seconds: float, rate: float) -> None:
        self.path, self.wanted = path, count
        tried = max(1, min(TRIED, int(rate * seconds / count)))
        self._rate = f"{count * tried}/{seconds:.6f}"
        self._files: list[Path] = []

    def __len__(self) -> int:
        return self.wanted

    def __getitem__(self, view: Any) -> Any:
        if not self._files:
            self._files = self._extract()
        chosen = self._files[view]
        return [read_image(f)[0] for f in chosen] if isinstance(view, slice) else read_image(chosen)[0]

    def _extract(self) -> list[Path]:
        folder = tempfile.TemporaryDirectory(prefix="cat3d-frames-")
        atexit.register(folder.cleanup)
        chosen = self._sharpest()
        # The same resampling in time as when they were compared, so that the numbers mean the same frames.
        wanted = "+".join(f"eq(n\\,{n})" for n in chosen)
        filters = f"fps={self._rate},select={wanted}"
        done = subprocess.run(
            self._command(["-vf", filters, "-fps_mode", "passthrough", f"{folder.name}/%06d.png"]), capture_output=True
        )
        if done.returncode:
            reason = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise InputError(f"{self.path} cannot be decoded ({reason[-1] if reason else 'no reason given'}).")
        files = sorted(Path(folder.name).iterdir())
        if len(files) != self.wanted:
            raise InputError(
                f"{self.path} gave {len(files)} of {self.wanted} frames: it is shorter or damaged; "
                "set ingest.frames to fewer."
            )
        return files

    def _sharpest(self) -> list[int]:
        """For each stretch the number, in the resampled video, of the frame with the largest mean squared Laplacian."""
        filters = f"fps={self._rate},scale={SHARPNESS_WIDTH}:-2,format=gray"
        command = self._command(["-vf", filters, "-f", "image2pipe", "-c:v", "pgm", "-"])
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as running:
            assert running.stdout is not None
            scores = [sharpness(image) for image in _pgm_images(running.stdout)]
        if len(scores) < self.wanted:
            raise InputError(f"{self.path} has only {len(scores)} frames; set ingest.frames to fewer than that.")
        bounds = np.linspace(0, len(scores), self.wanted + 1).round().astype(int)
        return [int(a + np.argmax(scores[a:b])) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]

    def _command(self, arguments: list[str]) -> list[str]:
        ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
        return [ffmpeg, "-v", "error", "-nostdin", "-i", f"file:{self.path}", "-an", *arguments]


def sharpness(image: np.ndarray) -> float:
    """Mean squared Laplacian of a grey image (H, W), 0 to 255."""
    x = image.astype(np.float32)
    laplacian = 4 * x[1:-1, 1:-1] - x[:-2, 1:-1] - x[2:, 1:-1] - x[1:-1, :-2] - x[1:-1, 2:]
    return float((laplacian**2).mean())


def _pgm_images(stream: IO[bytes]) -> Iterator[np.ndarray]:
    """The grey images (H, W) uint8 of a stream of binary PGM files."""
    while stream.readline() == b"P5\n":
        width, height = (int(side) for side in stream.readline().split())
        stream.readline()
        raw = stream.read(width * height)
        if len(raw) == width * height:
            yield np.frombuffer(raw, np.uint8).reshape(height, width)
