"""What resting cameras see, rendered by the reconstruction itself: coarse at once, then finer, one tile at a time.

One thread renders for all browsers. It always goes on with the coarsest picture that anyone waits for, and looks for
newer wishes after every tile, so that a camera that moves on stops what was rendered for it at once.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.reconstruction import Reconstructor
from flows.media.images import to_uint8
from flows.media.pictures import depth_picture

SCALES = (1 / 8, 1 / 4, 1 / 2, 1.0)
TILE = 96
"""Pixels on a side: a tenth of a second or two of a field on a CPU core."""
CHANNELS = ("colour", "depth", "normals", "opacity", "uncertainty")


class StoppedError(Exception):
    """The viewer ends: leave whatever you do."""


@dataclass(frozen=True)
class Wish:
    """What a browser rests on: one camera (scene frame) of its window's size, what of it to show, and the scene; with a
    second scene, that one is shown to the right of `split`, a share of the width."""

    camera: Cameras
    channel: str
    scene: Reconstructor
    other: Reconstructor | None = None
    split: float = 0.5


@dataclass(frozen=True)
class Picture:
    """image (h, w, 3) uint8; depth (h, w) float32 in scene units; scale of the window's size."""

    image: np.ndarray
    depth: np.ndarray
    scale: float


@dataclass
class _Work:
    wish: Wish
    rung: int = 0
    tiles: Iterator[tuple[slice, slice]] | None = None
    parts: dict[str, np.ndarray] = field(default_factory=dict)


class Ladder:
    """Give it wishes with `look`; it answers through `show(who, wish, picture)`, from its own thread."""

    def __init__(self, show: Callable[[int, Wish, Picture], None], scales: tuple[float, ...] = SCALES) -> None:
        self._show, self._scales = show, scales
        self._work: dict[int, _Work] = {}
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="ladder", daemon=True)
        self._thread.start()

    def look(self, who: int, wish: Wish | None) -> None:
        """Render this for `who` from now on, and nothing else; None: nothing at all."""
        with self._changed:
            self._work.pop(who, None)
            if wish is not None:
                self._work[who] = _Work(wish)
            self._changed.notify_all()

    def wait(self) -> None:
        """Return once everybody has a picture of half size or nothing to wait for: what else works on the same cores
        asks here. Raises StoppedError after `stop`."""
        last = len(self._scales) - 1
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or all(w.rung >= last for w in self._work.values()))
            if self._stopped:
                raise StoppedError

    def stop(self) -> None:
        """End the thread, after the tile that it is at."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._work or self._stopped)
                if self._stopped:
                    return
                who, work = min(self._work.items(), key=lambda item: (item[1].rung, item[0]))
            try:
                picture = self._advance(work)
            except Exception:  # a scene of someone else's may fail at a view; the others go on
                traceback.print_exc()
                self._forget(who, work)
                continue
            if picture is not None and self._is_wanted(who, work):
                self._show(who, work.wish, picture)
            if work.rung == len(self._scales):
                self._forget(who, work)

    def _is_wanted(self, who: int, work: _Work) -> bool:
        with self._changed:
            return self._work.get(who) is work

    def _forget(self, who: int, work: _Work) -> None:
        with self._changed:
            if self._work.get(who) is work:
                del self._work[who]

    def _advance(self, work: _Work) -> Picture | None:
        """Render the next tile; the picture where it was the last one."""
        scale = self._scales[work.rung]
        width, height = (max(1, round(float(side) * scale)) for side in work.wish.camera.size[0])
        camera = work.wish.camera.resize(width, height)
        if work.tiles is None:
            work.tiles, work.parts = tiles(width, height), {}
        area = next(work.tiles, None)
        if area is not None:
            _render(work, camera, area)
            return None
        with self._changed:
            work.rung, work.tiles = work.rung + 1, None
            self._changed.notify_all()
        return Picture(_coloured(work.parts, work.wish.channel), work.parts["depth"], scale)


def tiles(width: int, height: int, side: int = TILE) -> Iterator[tuple[slice, slice]]:
    """(rows, columns) of the tiles of an image, the middle ones first: there one looks."""
    areas = [
        (slice(y, min(y + side, height)), slice(x, min(x + side, width)))
        for y in range(0, height, side)
        for x in range(0, width, side)
    ]

    def off(area: tuple[slice, slice]) -> float:
        rows, columns = area
        return float(abs(rows.start + rows.stop - height) + abs(columns.start + columns.stop - width))

    yield from sorted(areas, key=off)


def _render(work: _Work, camera: Cameras, area: tuple[slice, slice]) -> None:
    """Render one tile into `work.parts`, from the one scene or, where it lies across the split, from both."""
    rows, columns = area
    wish, width = work.wish, int(camera.size[0, 0])
    edge = width if wish.other is None else min(max(round(wish.split * width), 0), width)
    sides = ((wish.scene, columns.start, min(columns.stop, edge)), (wish.other, max(columns.start, edge), columns.stop))
    for scene, left, right in sides:
        if scene is None or left >= right:
            continue
        part = camera.crop(left, rows.start, right - left, rows.stop - rows.start)
        for name, values in _channels(scene, part, wish.channel).items():
            shape = (int(camera.size[0, 1]), width, *values.shape[2:])
            whole = work.parts.setdefault(name, np.zeros(shape, np.float32))
            whole[rows, left:right] = values


def _channels(scene: Reconstructor, camera: Cameras, channel: str) -> dict[str, np.ndarray]:
    """What a picture is made of: depth, and what the channel shows."""
    with torch.no_grad():
        render = scene.render(camera, 0)
        found = {"depth": render.depth}
        if channel == "uncertainty":
            known = scene.uncertainty(camera, 0)
            found["shown"] = render.opacity * 0 if known is None else known
        elif channel != "depth":
            found["shown"] = {"colour": render.image, "normals": render.normals, "opacity": render.opacity}[channel]
        return {name: value.float().cpu().numpy() for name, value in found.items()}


def _coloured(parts: dict[str, np.ndarray], channel: str) -> np.ndarray:
    """(h, w, 3) uint8: colours as they are, normals -1 to 1 as black to white, shares as grey."""
    if channel == "depth":
        return depth_picture(parts["depth"])
    shown = parts["shown"]
    if channel == "normals":
        shown = 0.5 + 0.5 * shown
    return to_uint8(shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, -1))
