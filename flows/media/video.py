"""Videos: frames, encoded by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from torch import Tensor

from flows.errors import InputError
from flows.media.images import to_uint8


def write_video(path: Path | str, frames: Iterable[np.ndarray | Tensor], fps: float = 30) -> int:
    """Write frames (H, W, 3), all of one size, as H.264 yuv420p mp4 that browsers play; the number of frames written.

    Odd sizes lose their last row or column (the codec halves the colour planes). Raises InputError for no frames, or
    for a frame of another size.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    writer, first, count = None, None, 0
    try:
        for frame in frames:
            pixels = to_uint8(frame)
            first = first or pixels.shape
            if pixels.shape != first:
                raise InputError(
                    f"Frame {count} of {path} is {pixels.shape}, the first was {first}; they must be equal."
                )
            pixels = pixels[: first[0] // 2 * 2, : first[1] // 2 * 2, :3]
            if writer is None:
                writer = imageio_ffmpeg.write_frames(
                    str(partial), pixels.shape[1::-1], fps=fps, codec="libx264", pix_fmt_out="yuv420p", quality=8,
                    macro_block_size=2, output_params=["-movflags", "+faststart"], ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(pixels))
            count += 1
        if writer is None:
            raise InputError(f"There are no frames to write into {path}.")
        writer.close()  # which does not say how ffmpeg ended
        if not _is_whole(partial, count):
            raise InputError(f"{path} cannot be written: not all of it reached the disk, which may be full.")
        os.replace(partial, path)
        return count
    finally:
        if writer is not None:
            writer.close()
        partial.unlink(missing_ok=True)


def _is_whole(path: Path, count: int) -> bool:
    """Whether the file is a video of `count` frames, read without decoding them."""
    try:
        return int(imageio_ffmpeg.count_frames_and_secs(str(path))[0]) == count
    except (OSError, RuntimeError):
        return False
