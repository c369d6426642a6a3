"""What one browser sees: the run it has chosen, its panel, and what its camera rests on."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import numpy as np
import torch
import viser

from cat3d_core.cameras import Cameras
from flows.errors import describe
from flows.exports.preview import within
from flows.media.images import to_uint8
from flows.reporting.content import ShownView
from flows.viewer import layers
from flows.viewer.beside import SIDE
from flows.viewer.cameras import camera_of, place, vertical_fov
from flows.viewer.ladder import Ladder, Picture, Wish
from flows.viewer.panel import Panel
from flows.viewer.run import OpenRun, Runs

REST = 0.25
"""Seconds without a move after which a camera rests."""
FRUSTUM = 0.08
"""Size of a frustum in scene units: the cameras look at the origin from about 1."""
HIDDEN = 2.5 * FRUSTUM
"""Cameras that are nearer than this to the one that looks are left out: their pictures would be all that it sees."""


class Session:
    """One browser. Its callbacks come from viser's threads, its pictures from the ladder's: a lock keeps them apart."""

    def __init__(self, runs: Runs, ladder: Ladder, client: viser.ClientHandle) -> None:
        self.runs, self.ladder, self.client = runs, ladder, client
        self.run: OpenRun | None = None
        self._lock = threading.RLock()
        self._views: dict[str, list[Any]] = {}
        self._layers: dict[str, Any] = {}
        self._placed = False
        self._timer: threading.Timer | None = None
        self._resting = False
        self.shown_picture: tuple[Wish, Picture] | None = None
        self.panel = Panel(self)
        client.camera.on_update(lambda _: self.moved())

    def close(self) -> None:
        """Forget the browser."""
        if self._timer is not None:
            self._timer.cancel()
        self.ladder.look(self.client.client_id, None)

    # What there is to see

    def open(self, run: OpenRun) -> None:
        """Show another run, from its first captured view as soon as there is one."""
        with self._lock:
            self.run = run
            self.client.scene.reset()
            self._views, self._layers, self._placed = {}, {}, False
            self.draw()
            self.panel.opened()
        self.moved()

    def draw(self) -> None:
        """Draw everything of the run that is not drawn yet, or changed."""
        run = self.run
        if run is None:
            return
        with self._lock, self.client.atomic():
            for view in run.views:
                handles = self._views.setdefault(layers.GROUPS[view.kind], [])
                if all(handle.name != f"/{layers.GROUPS[view.kind]}/{view.index}" for handle in handles):
                    handles.append(layers.add_view(self.client.scene, view, FRUSTUM, self.clicked))
            for handle in list(self._views.get("planned", [])):
                if any(h.name == handle.name.replace("planned", "generated") for h in self._views.get("generated", [])):
                    handle.remove()  # it has its picture now
                    self._views["planned"].remove(handle)
            planned = [view for view in run.views if view.kind in ("planned", "generated")]
            self._layers["path"] = layers.add_path(self.client.scene, planned)
            if self._layers.get("points") is None:
                self._layers["points"] = layers.add_points(self.client.scene, run.points)
            if run.splats is not None:
                self._layers["splats"] = layers.add_splats(self.client.scene, run.splats, not self._resting)
            if run.views and not self._placed:  # a run that has just begun has no cameras yet
                self._placed = True
                self.fly(run.views[0].camera)
        self.shown()

    def shown(self) -> None:
        """Show and hide what the panel says."""
        on, camera = self.panel.shown, self.camera()
        here = None if camera is None else place(camera)[1]
        with self._lock:
            for group, handles in self._views.items():
                for handle in handles:
                    close = here is not None and float(np.linalg.norm(handle.position - here)) < HIDDEN
                    if handle.visible != (on(group) and not close):
                        handle.visible = not handle.visible
            for name, handle in self._layers.items():
                if handle is not None:
                    handle.visible = on(name) and not (name == "splats" and self._resting)

    # Where the camera is

    def camera(self) -> Cameras | None:
        """The browser's camera (scene frame), None before it has said where it is."""
        camera = self.client.camera
        with contextlib.suppress(AssertionError):
            return camera_of(camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height)
        return None

    def moved(self) -> None:
        """The camera moves, or what it looks at changes: splats until it rests, then the reconstruction itself."""
        self.ladder.look(self.client.client_id, None)
        with self._lock:
            if self._resting:
                self._resting, self.shown_picture = False, None
                self.client.scene.set_background_image(None)
            self.shown()
            if self._timer is not None:
                self._timer.cancel()
            self._timer = threading.Timer(REST, self.rest)
            self._timer.daemon = True
            self._timer.start()

    def rest(self) -> None:
        """Have the ladder render what the camera sees."""
        camera, run = self.camera(), self.run
        if camera is None or run is None or run.scene is None or not self.panel.shown("reconstruction"):
            return
        other = self.panel.compared()
        wish = Wish(camera, self.panel.channel, run.scene, other.scene if other else None, self.panel.split)
        self.ladder.look(self.client.client_id, wish)

    def picture(self, wish: Wish, picture: Picture) -> None:
        """Show what the ladder rendered, with its depth, so that frusta before it stay visible."""
        with self._lock:
            if not self._resting:
                self._resting = True
                self.shown()
            # Sharp pictures without loss; coarse ones are on their way out anyway.
            form: Any = "png" if picture.scale == 1.0 else "jpeg"
            self.client.scene.set_background_image(picture.image, form, depth=picture.depth)
            self.shown_picture = wish, picture

    def fly(self, camera: Cameras) -> None:
        """Put the browser's camera at a camera (scene frame)."""
        wxyz, position = place(camera)
        with self.client.atomic():
            self.client.camera.wxyz = wxyz
            self.client.camera.position = position
            self.client.camera.fov = vertical_fov(camera)

    def clicked(self, view: ShownView) -> None:
        """Fly to a view, and show its photo and generated view beside what the reconstruction shows there."""
        self.fly(view.camera)
        run = self.run
        rendered = None
        if run is not None and run.scene is not None:
            try:
                camera = within(view.camera, SIDE).to(dtype=torch.float32)
                with torch.no_grad():
                    rendered = to_uint8(run.scene.render(camera, 0).image.cpu())
            except Exception as error:
                self.say(describe(error) or str(error))
        self.panel.beside(view, rendered)

    def say(self, text: str) -> None:
        """Show a sentence to the user."""
        self.client.add_notification("cat3d", text, auto_close_seconds=10.0)
