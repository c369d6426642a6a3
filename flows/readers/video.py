"""A video of a scene: the sharpest frame of each of equal stretches of time; poses are estimated later."""

from __future__ import annotations

from pathlib import Path

from flows.errors import InputError
from flows.media.files import VIDEOS
from flows.media.frames import VERSION, VideoFrames, video_length
from flows.readers import splits
from flows.readers.base import FRAMES, Capture
from schemas.content_key import content_key, file_sha256

LOOKS_FOR = "a video file (mp4, mov, ...)"


def detect(path: Path) -> bool:
    return path.is_file() and path.suffix[1:].lower() in VIDEOS


def read(path: Path, image_folder: str | None, view_counts: tuple[int, ...], frames: int = FRAMES) -> Capture:
    """`frames` views, named by the time in seconds at which their stretch begins. Every 8th is held out.

    Nothing is decoded before a frame is looked at. Raises InputError for a file that is no video.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a video file.")
    seconds, rate = video_length(path)
    wanted, frames = frames, max(1, min(frames, int(seconds * rate)))
    few = [f"The video has no {wanted} frames; all {frames} are taken."] if frames < wanted else []
    digest = file_sha256(path)
    return Capture(
        scene_id=path.resolve().stem,
        dataset="photos",
        names=[f"{i:04d}_at_{seconds * i / frames:.2f}s" for i in range(frames)],
        images=VideoFrames(path, frames, seconds, rate),
        image_digests=[content_key(video=digest, frames=frames, frame=i, version=VERSION) for i in range(frames)],
        splits=splits.every_8th(frames, view_counts),
        notes=[
            *few,
            f"{frames} frames of {seconds:.1f} s of video: the sharpest of each {seconds / frames:.2f} s; "
            "--set ingest.frames=N takes N.",
            splits.EVERY_8TH,
        ],
    )
