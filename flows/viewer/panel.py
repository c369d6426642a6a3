"""The panel of a browser: runs, what is shown, views side by side, keyframes, and the table of a sweep."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import viser

from cat3d_core.cameras import Cameras
from flows.errors import InputError, describe
from flows.exports.path import parse_path
from flows.reporting.content import ShownView
from flows.viewer.beside import companions, side_by_side
from flows.viewer.keyframes import FPS, as_bytes, nerfstudio_document, path_document, smooth_path
from flows.viewer.ladder import CHANNELS
from flows.viewer.results import Results
from flows.viewer.run import OpenRun, Runs

LAYERS = ("reconstruction", "splats", "points", "captured", "held out", "generated", "planned", "path")
NOTHING = "nothing"
SECONDS_A_KEYFRAME = 2.0


class Sight(Protocol):
    """What the panel steers: what one browser sees."""

    client: viser.ClientHandle
    runs: Runs
    run: OpenRun | None

    def open(self, run: OpenRun) -> None: ...
    def moved(self) -> None: ...
    def shown(self) -> None: ...
    def camera(self) -> Cameras | None: ...
    def fly(self, camera: Cameras) -> None: ...
    def say(self, text: str) -> None: ...


class Panel:
    """The controls, one browser's own."""

    def __init__(self, session: Sight) -> None:
        self.session = session
        self.keyframes: list[Cameras] = []
        gui = session.client.gui
        self._results: Results | None = None
        names = session.runs.names
        self._run: Any = gui.add_dropdown("Run", names)
        self._run.on_update(lambda _: self._open(self._run.value))
        self._state = gui.add_markdown("")
        with gui.add_folder("Show"):
            self._channel = gui.add_dropdown("Picture", CHANNELS)
            self._other = gui.add_dropdown("Compare with", (NOTHING, *names))
            self._split = gui.add_slider("Split", 0.0, 1.0, 0.01, 0.5)
            self._on: dict[str, Any] = {
                name: gui.add_checkbox(name.capitalize(), name not in ("planned",)) for name in LAYERS
            }
        renewing: list[Any] = [self._channel, self._other, self._split, self._on["reconstruction"]]
        for control in renewing:
            control.on_update(lambda _: session.moved())
        for name in LAYERS[1:]:
            self._on[name].on_update(lambda _: session.shown())
        with gui.add_folder("View") as self._beside:
            self._beside_text = gui.add_markdown("Click a camera: its photo, generated view and render, side by side.")
        self._beside_image: Any = None
        with gui.add_folder("Camera path", expand_by_default=False):
            self._count = gui.add_markdown("No keyframes yet.")
            self._button("Add keyframe", self._add)
            self._button("Remove last", self._remove)
            self._closed = gui.add_checkbox("Closed", False)
            self._button("Save path", lambda: self._save("path.json", path_document))
            self._button("Save for nerfstudio", lambda: self._save("camera_path.json", nerfstudio_document))
            upload = gui.add_upload_button("Load path")
            upload.on_upload(lambda _: self._guarded(lambda: self._load(upload.value.content)))
        self.listed()

    def _button(self, label: str, act: Callable[[], Any]) -> None:
        self.session.client.gui.add_button(label).on_click(lambda _: self._guarded(act))

    def _guarded(self, act: Callable[[], Any]) -> None:
        """Say what is wrong instead of failing silently in a thread."""
        try:
            act()
        except Exception as error:
            self.session.say(describe(error) or str(error))

    # What is chosen

    @property
    def channel(self) -> str:
        """One of CHANNELS."""
        return str(self._channel.value)

    @property
    def split(self) -> float:
        """Share of the width to the left of the other run."""
        return float(self._split.value)

    def shown(self, name: str) -> bool:
        """Whether a layer is to be seen."""
        return bool(self._on[name].value)

    def show(self, name: str, on: bool) -> None:
        """Show a layer or hide it."""
        self._on[name].value = on

    def compared(self) -> OpenRun | None:
        """The other run, where one is to be seen beside."""
        name = str(self._other.value)
        if name in (NOTHING, self._run.value):
            return None
        try:
            return self.session.runs.opened(name)
        except Exception as error:
            self.session.say(describe(error) or str(error))
            return None

    def _open(self, name: str) -> None:
        self._guarded(lambda: self.session.open(self.session.runs.opened(name)))

    def opened(self) -> None:
        """Say what the run is and how far it has come."""
        run = self.session.run
        if run is None:
            return
        if self._run.value != run.name:
            self._run.value = run.name
        self._state.content = run.state()

    def listed(self) -> None:
        """Offer the runs that there are now, and their results."""
        runs = self.session.runs
        if tuple(self._run.options) != tuple(runs.names):
            self._run.options, self._other.options = tuple(runs.names), (NOTHING, *runs.names)
        if runs.table is not None:
            if self._results is None:
                self._results = Results(self.session.client.gui, runs.table, self._open)
            elif self._results.table != runs.table:
                self._results.show(runs.table)

    def beside(self, view: ShownView, rendered: np.ndarray | None) -> None:
        """Show the photo, the generated view and the reconstruction's render of a camera side by side."""
        shown = companions(view, self.session.run.views if self.session.run else [])
        if rendered is not None:
            shown.append(("rendered", rendered))
        if self._beside_image is not None:
            self._beside_image.remove()
            self._beside_image = None
        self._beside_text.content = f"**{view.name}**: {' | '.join(caption for caption, _ in shown)}"
        if shown:
            with self._beside:
                picture = side_by_side([picture for _, picture in shown])
                self._beside_image = self.session.client.gui.add_image(picture, format="png")

    # Keyframes

    def _add(self) -> None:
        camera = self.session.camera()
        if camera is not None:
            self.keyframes.append(camera)
        self._told()

    def _remove(self) -> None:
        self.keyframes = self.keyframes[:-1]
        self._told()

    def _told(self) -> None:
        count = len(self.keyframes)
        self._count.content = f"{count} keyframe{'s' * (count != 1)}." if count else "No keyframes yet."

    def path(self) -> Cameras:
        """The smooth path through the keyframes. Raises InputError for fewer than two."""
        if len(self.keyframes) < 2:
            raise InputError("A camera path needs two keyframes: move the camera and add another one.")
        steps = len(self.keyframes) - (not self._closed.value)
        return smooth_path(self.keyframes, round(steps * SECONDS_A_KEYFRAME * FPS), bool(self._closed.value))

    def _save(self, name: str, document: Callable[..., dict[str, Any]]) -> None:
        run = self.session.run
        if run is not None and run.frame_from_scene is not None:
            content = as_bytes(document(self.path(), run.frame_from_scene))
            self.session.client.send_file_download(name, content)

    def _load(self, content: bytes) -> None:
        """Take the cameras of a path file (ours or nerfstudio's), at most 20 of them, as keyframes."""
        run, here = self.session.run, self.session.camera()
        if run is None or here is None or run.frame_from_scene is None:
            return
        width, height = (int(side) for side in here.size[0])
        try:
            document = json.loads(content)
        except ValueError as error:
            raise InputError(f"The file is not JSON ({error}).") from None
        path = parse_path(document, "The path", width, height).cameras
        cameras = run.frame_from_scene.inverse().cameras(path)
        step = max(1, -(-len(cameras) // 20))
        self.keyframes = [cameras[i] for i in range(0, len(cameras), step)]
        self._told()
        self.session.fly(self.keyframes[0])
