"""The server of `cat3d view`: the runs of a folder or a store, opened when someone looks, and kept up to date."""

from __future__ import annotations

import contextlib
import threading
import traceback
from pathlib import Path

import viser

from flows.errors import InputError, describe
from flows.exports.preview import make_preview
from flows.reporting import content
from flows.viewer.folder import ResultTable, result_table
from flows.viewer.ladder import Ladder, Picture, Wish
from flows.viewer.run import OpenRun
from flows.viewer.session import Session
from schemas.errors import StoreError
from schemas.scene_store import SceneStore

HOST = "127.0.0.1"
POLL = 2.0
"""Seconds between two looks at the stores that someone watches."""


class Viewer:
    """Serves the runs of a store or a folder on the loopback address, until `stop`. Raises InputError where there is
    nothing to see."""

    def __init__(self, path: Path, run: str | None = None, port: int = 8080) -> None:
        self.names = run_names(path)
        chosen = [name for name in self.names if run is None or name.rpartition(" / ")[2] == run]
        if not chosen:
            known = ", ".join(self.names) or "none"
            raise InputError(
                f"{path} has no run {run} to show; its runs are: {known}." if run else f"{path} has no run yet."
            )
        self.first = chosen[0]
        self.names = [self.first, *(name for name in self.names if name != self.first)]
        self.table: ResultTable | None = result_table(path) if path.suffix != ".zarr" else None
        self._open: dict[str, OpenRun] = {}
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self.sessions: dict[int, Session] = {}
        self.ladder = Ladder(self._picture)
        self.server = viser.ViserServer(host=HOST, port=port, label="cat3d", verbose=False)  # or the next free port
        self.port = self.server.get_port()
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)
        self._path_of = {name: store_path(path, name) for name in self.names}
        self._watcher = threading.Thread(target=self._watch, name="watch", daemon=True)
        self._watcher.start()

    def stop(self) -> None:
        """End everything."""
        self._stopped.set()
        self.ladder.stop()
        self.server.stop()
        self._watcher.join(timeout=10)

    def opened(self, name: str) -> OpenRun:
        """A run by its name, read at the first call. Raises InputError or StoreError where it cannot be."""
        with self._lock:
            if name not in self._open:
                store = SceneStore.open(self._path_of[name])
                made = OpenRun(name, store, store.run(name.rpartition(" / ")[2]))
                made.read()
                self._open[name] = made
            return self._open[name]

    def _connected(self, client: viser.ClientHandle) -> None:
        session = Session(self, self.ladder, client)
        self.sessions[client.client_id] = session
        try:
            session.open(self.opened(self.first))
        except (InputError, StoreError) as error:
            session.say(str(error))

    def _left(self, client: viser.ClientHandle) -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _picture(self, who: int, wish: Wish, picture: Picture) -> None:
        session = self.sessions.get(who)
        if session is not None:
            session.picture(wish, picture)

    def _watch(self) -> None:
        """Look for what is new in the runs that someone sees, and make the splats that are missing."""
        while not self._stopped.wait(POLL if self._open else 0.1):
            for run in {id(s.run): s.run for s in list(self.sessions.values()) if s.run is not None}.values():
                try:
                    self._refresh(run)
                except (
                    Exception
                ) as error:  # a store that is being written may be read too early: again at the next look
                    if describe(error) is None:
                        traceback.print_exc()

    def _refresh(self, run: OpenRun) -> None:
        changed = content.shape_of(run.store, run.run) != run.shape
        if changed:
            with self._lock:
                run.read()
        made = False
        if run.splats is None and run.scene is not None and run.cameras is not None:
            run.splats = make_preview(run.store, run.run, run.scene, run.cameras)
            made = True
        if changed or made:
            for session in list(self.sessions.values()):
                if session.run is run:
                    session.draw()
                    session.panel.opened()
                    if changed:
                        session.moved()


def run_names(path: Path) -> list[str]:
    """The runs of a store, or of all stores of a folder as "scene / run". Raises InputError where there is no store."""
    if path.suffix == ".zarr":
        return SceneStore.open(path).runs()
    stores = sorted(path.glob("*.zarr")) if path.is_dir() else []
    if not stores:
        raise InputError(f"{path} holds no scene store; give a .zarr folder, or the --out folder of a run or sweep.")
    names = []
    for store in stores:
        with contextlib.suppress(StoreError):  # a damaged one does not hide the others
            names += [f"{store.name.removesuffix('.zarr')} / {run}" for run in SceneStore.open(store).runs()]
    return names


def store_path(path: Path, name: str) -> Path:
    """The store of a run of `run_names`."""
    scene, _, _ = name.rpartition(" / ")
    return path / f"{scene}.zarr" if scene else path
