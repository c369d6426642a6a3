"""A folder on object storage and its working copy: what differs is copied, in an order that leaves nothing half done.

A copying to the bucket first writes down what it may change, then the data, then the records of stages that speak of
them, and last that it is complete. Whoever finds one that was not completed, and is not the machine that can complete
it, does not trust what it touched: those scenes are done again.
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import Any

import obstore
from obstore.exceptions import BaseError, NotFoundError
from obstore.store import S3Store

from flows.errors import InputError, WorkerError
from flows.locks import only_worker
from flows.object_storage.address import Address
from flows.object_storage.claim import Claim, State, read_state
from flows.progress import console, meter
from schemas.documents import write_bytes

INDEX = ".mirror.json"
THREADS = 8
#: Folders of tables, whose files belong to runs; everything else belongs to the scene of its first folder.
TABLES = ("metrics", "timings")
#: A connection that fails is tried again for so long.
RETRIES: Any = {"max_retries": 6, "retry_timeout": timedelta(seconds=60)}


class Mirror:
    """Files whose name or folder begins with a dot (locks, workers' files, clones) stay on this machine."""

    def __init__(self, address: Address) -> None:
        self.address, self.folder = address, address.working_copy()
        with self._naming():
            self.store = S3Store.from_url(str(address), client_options=_client_options(), retry_config=RETRIES)
        self.claim = Claim(self.store, str(address))
        self.next = 0.0
        self.folder.mkdir(parents=True, exist_ok=True)
        self.index = _Index(self.folder / INDEX)

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Be the only command that writes the folder; the working copy is what the bucket holds, or ahead of it. What
        was done is copied at the end, also after an error."""
        with self._naming():
            self.claim.take()
        try:
            self._bring_up_to_date(self.claim.state)
            yield self.folder
        finally:
            try:
                self.push()
            finally:
                with self._naming():
                    self.claim.release()

    def read(self) -> Path:
        """The working copy, brought up to date where no command of this machine works on it."""
        with self._naming():
            state, tag = read_state(self.store)
        if tag is None:
            raise InputError(f"{self.address} holds no results: nothing was ever copied there.")
        self._bring_up_to_date(state)
        return self.folder

    def push(self) -> None:
        """Copy to the bucket what is new or changed in the working copy, and remove there what is gone."""
        started = time.monotonic()
        found = dict(_files(self.folder))
        changed = [p for p, stat in found.items() if self.index.stat(p) != stat]
        records = {p: self._read(p, found[p]) for p in changed if "stages" in PurePosixPath(p).parts}
        gone = [p for p in self.index.files if p not in found]
        if not changed and not gone:
            return
        with self._naming():
            state = self.claim.state
            touched = sorted({*map(_part, (*changed, *gone)), *state.touched})
            self.claim.change(writer=self.index.name, generation=state.generation + 1, touched=tuple(touched))
            self._each(gone, self._remove, None)
            self._each([p for p in changed if p not in records], lambda p: self._put(p, found[p]), "copying to S3")
            self._each([p for p, data in records.items() if data], lambda p: self._put(p, found[p], records[p]), None)
            self.index.write()
            self.claim.change(touched=())
        ended = time.monotonic()
        self.next = ended + 20 * (ended - started)  # copying takes at most a twentieth of the time

    def _read(self, path: str, stat: tuple[int, int]) -> bytes | None:
        """A record as it was when its stage's data were listed; None where it was changed since: it is for the next
        copying, with the data that it speaks of."""
        try:
            data = (self.folder / path).read_bytes()
            return data if _stat(self.folder / path) == stat else None
        except FileNotFoundError:
            return None

    def _put(self, path: str, stat: tuple[int, int], data: bytes | None = None) -> None:
        try:
            result = obstore.put(self.store, path, self.folder / path if data is None else data)
        except FileNotFoundError:  # removed meanwhile: the next copying removes it there too
            return
        self.index.files[path] = (*stat, result["e_tag"] or "")

    def _remove(self, path: str) -> None:
        with suppress(NotFoundError, FileNotFoundError):
            obstore.delete(self.store, path)
        self.index.files.pop(path, None)

    def _bring_up_to_date(self, state: State) -> None:
        """Copy from the bucket what is newer there, unless the working copy is equal to it or ahead, as by what a
        killed command did not come to copy."""
        with only_worker(self.folder / ".mirror.lock", f"Copying from {self.address}", 600.0):
            self.index = _Index(self.folder / INDEX)
            if self.index.fetching or (state.writer != self.index.name and state.version != self.index.version):
                self._fetch(state)

    def _fetch(self, state: State) -> None:
        ahead = [p for p, stat in _files(self.folder) if self.index.stat(p) != stat]
        if ahead and not self.index.fetching:
            self._set_aside(ahead)
        self.index.fetching = True
        self.index.write()
        with self._naming():
            there = {o["path"]: o["e_tag"] or "" for batch in obstore.list(self.store) for o in batch}
        kept = {p: tag for p, tag in there.items() if _is_result(p)}
        if state.touched:
            doubtful = [p for p in kept if _part(p) in state.touched]
            console.print(
                f"{self.address}: copying was not completed there ({', '.join(state.touched)}): this is done again.",
                markup=False,
            )
            for path in doubtful:
                del kept[path]
        for path, _ in list(_files(self.folder)):
            if path not in kept:
                _remove_file(self.folder, path)
                self.index.files.pop(path, None)
        wanted = [p for p, tag in kept.items() if self.index.tag(p) != tag]
        with self._naming():
            self._each(wanted, lambda p: self._get(p, kept[p]), "copying from S3")
        for path in there.keys() - kept.keys():  # so that the next copying removes them there
            if _is_result(path):
                self.index.files[path] = (-1, -1, "")
        self.index.version, self.index.fetching = state.version, False
        self.index.write()

    def _get(self, path: str, tag: str) -> None:
        target = self.folder / path
        if not target.resolve().is_relative_to(self.folder.resolve()):
            raise InputError(f"{self.address} holds {path}, which leads out of the folder.")
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target, bytes(obstore.get(self.store, path).bytes()))
        self.index.files[path] = (*_stat(target), tag)

    def _set_aside(self, ahead: list[str]) -> None:
        """Another machine went on from an older state than this one: its results count, these are kept beside."""
        aside = self.folder.with_name(f"{self.folder.name}.kept-{time.strftime('%Y%m%d-%H%M%S')}")
        self.folder.rename(aside)
        self.folder.mkdir()
        self.index = _Index(self.folder / INDEX)
        console.print(
            f"{self.address} was written from another machine meanwhile. {len(ahead)} files that this one had not "
            f"copied there yet are kept in {aside}.", markup=False,
        )  # fmt: skip

    def _each(self, paths: Iterable[str], do: Callable[[str], None], what: str | None) -> None:
        paths = list(paths)
        with ThreadPoolExecutor(THREADS) as threads, meter(what or "", len(paths), quiet=what is None) as progress:
            for _ in threads.map(do, paths):
                progress.advance()

    @contextmanager
    def _naming(self) -> Iterator[None]:
        """Turn what the storage answers into a sentence."""
        try:
            yield
        except (BaseError, FileNotFoundError, PermissionError) as error:
            said = str(error).split("\n")[0][:300]
            raise WorkerError(
                f"{self.address} cannot be used: {said}. Give a bucket that exists, and its access in "
                "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and, if it is not Amazon's, AWS_ENDPOINT_URL. "
                f"What is done is kept in {self.folder}; run the same command again to go on."
            ) from error


class _Index:
    """What the working copy and the bucket had in common after the last copying: of each file its size and time here,
    and its tag there. name: the working copy's own; version: of the bucket's folder when it was copied from there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name, self.version, self.fetching = uuid.uuid4().hex, "", False
        self.files: dict[str, tuple[int, int, str]] = {}
        if path.exists():
            document = json.loads(path.read_text())
            self.name, self.version, self.fetching = document["name"], document["version"], document["fetching"]
            self.files = {p: (int(s), int(t), str(tag)) for p, (s, t, tag) in document["files"].items()}

    def write(self) -> None:
        document = {
            "name": self.name, "version": self.version, "fetching": self.fetching, "files": self.files
        }  # fmt: skip
        write_bytes(self.path, json.dumps(document).encode())

    def stat(self, path: str) -> tuple[int, int] | None:
        found = self.files.get(path)
        return None if found is None else found[:2]

    def tag(self, path: str) -> str | None:
        found = self.files.get(path)
        return None if found is None else found[2]


def _files(folder: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    """Files of results with their size and time."""
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(root, name)
            if name.startswith("."):
                continue
            try:
                yield path.relative_to(folder).as_posix(), _stat(path)
            except FileNotFoundError:
                continue


def _stat(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def _remove_file(folder: Path, path: str) -> None:
    """Remove a file, and the folders that are empty without it: an empty folder is no store."""
    (folder / path).unlink()
    for parent in PurePosixPath(path).parents:
        if parent == PurePosixPath() or any((folder / parent).iterdir()):
            return
        (folder / parent).rmdir()


def _is_result(path: str) -> bool:
    return not any(part.startswith(".") for part in PurePosixPath(path).parts)


def _part(path: str) -> str:
    """What a file belongs to: its scene's store, its folder of pictures, or in tables itself."""
    first, *rest = PurePosixPath(path).parts
    return path if first in TABLES or not rest else first


def _client_options() -> Any:
    """Servers on this machine and in closed networks speak HTTP: allowed where the endpoint that is given says so."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    return {"allow_http": True} if endpoint.startswith("http://") else {}
