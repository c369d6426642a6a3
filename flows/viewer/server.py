"""The server of `cat3d view`: the runs of a folder or a store, opened when someone looks, and kept up to date."""

from __future__ import annotations

import contextlib
import secrets
import threading
import traceback
from pathlib import Path

import viser

from flows.errors import InputError, describe
from flows.exports.preview import make_preview
from flows.reporting import content
from flows.viewer.folder import ResultTable, result_table, run_name
from flows.viewer.guard import LOOPBACK, Guard, serve
from flows.viewer.ladder import Ladder, Picture, StoppedError, Wish
from flows.viewer.run import OpenRun
from flows.viewer.session import Session
from schemas.errors import StoreError
from schemas.scene_store import SceneStore

HOST = "127.0.0.1"
POLL = 2.0
"""Seconds between two looks at the stores that someone watches."""


class Viewer:
    """Serves the runs of a store or a folder, until `stop`: on the loopback address, or on another one to those who
    know `token`. Raises InputError where there is nothing to see."""

    def __init__(self, path: Path, run: str | None = None, port: int = 8080, host: str = HOST) -> None:
        self.path, self._seen = path, contents(path)
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
        self.token = None if host in LOOPBACK else secrets.token_urlsafe(16)
        self.server = serve(Guard(self.token), host, port)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.port = self.server.get_port()
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)
        self._watcher = threading.Thread(target=self._watch, name="watch", daemon=True)
        self._watcher.start()

    def stop(self) -> None:
        """End everything."""
        self._stopped.set()
        self.ladder.stop()
        self.server.stop()
        self._watcher.join()  # at the next view or step of splats that it makes

    def opened(self, name: str) -> OpenRun:
        """A run by its name, read at the first call. Raises InputError or StoreError where it cannot be."""
        with self._lock:
            if name not in self._open:
                store = SceneStore.open(store_path(self.path, name))
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
            self._list()
            for run in {id(s.run): s.run for s in list(self.sessions.values()) if s.run is not None}.values():
                try:
                    self._refresh(run)
                except StoppedError:
                    return
                except Exception as error:
                    # A store that is being written may be read too early: it is read again at the next look.
                    if describe(error) is None:
                        traceback.print_exc()

    def _list(self) -> None:
        """Offer runs and results that are new since the last look."""
        seen = contents(self.path)
        if seen == self._seen:
            return
        try:
            new = [name for name in run_names(self.path) if name not in self.names]
            table = result_table(self.path) if self.path.suffix != ".zarr" else None
        except Exception as error:  # read while it is written: again at the next look
            if describe(error) is None:
                traceback.print_exc()
            return
        self._seen, self.names, self.table = seen, [*self.names, *new], table
        for session in list(self.sessions.values()):
            session.panel.listed()

    def _refresh(self, run: OpenRun) -> None:
        changed = content.shape_of(run.store, run.run) != run.shape
        if changed:
            with self._lock:
                run.read()
        made = False
        if run.splats is None and run.scene is not None and run.cameras is not None:
            run.splats = make_preview(run.store, run.run, run.scene, run.cameras, self.ladder.wait)
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
            names += [run_name(store.name.removesuffix(".zarr"), run) for run in SceneStore.open(store).runs()]
    return names


def store_path(path: Path, name: str) -> Path:
    """The store of a run of `run_names`."""
    scene, _, _ = name.rpartition(" / ")
    return path / f"{scene}.zarr" if scene else path


def contents(path: Path) -> tuple[tuple[str, int], ...]:
    """What changes when a run or its results are added: folders and when something was put into them."""
    stores = [path] if path.suffix == ".zarr" else path.glob("*.zarr")
    folders = [store / "runs" for store in stores] + [path / "metrics"]
    return tuple(sorted((str(folder), folder.stat().st_mtime_ns) for folder in folders if folder.is_dir()))
