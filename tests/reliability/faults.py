"""Control of `faults.c`: refuse the n-th call below a folder, or record every one of them.

The library must be loaded before the C library's own functions are bound: `environment` says how to start a process.
"""

from __future__ import annotations

import ctypes
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

SOURCE = Path(__file__).with_name("faults.c")


def built(folder: Path) -> Path:
    """The library, compiled into `folder`; skips where that can't be (it is for Linux and needs a C compiler)."""
    if not sys.platform.startswith("linux"):
        pytest.skip("Faults are injected by LD_PRELOAD, which is of Linux.")
    library = folder / "faults.so"
    compiler = os.environ.get("CC", "gcc")
    try:
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl", "-lpthread"], check=True)
    except FileNotFoundError:
        pytest.skip(f"There is no {compiler} to compile {SOURCE.name} with; CC names another one.")
    return library


def environment(library: Path) -> dict[str, str]:
    """Of a process in which faults can be injected."""
    return os.environ | {"LD_PRELOAD": str(library), "CAT3D_FAULTS": str(library), "OMP_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Event:
    """What happened to the file system: kind is c(reate), t(runcate at opening), w(rite), s(ync), l(ength), r(ename),
    m(ake folder) or u(nlink); `offset` of a write, or the new length."""

    kind: str
    path: str
    other: str = ""
    offset: int = 0
    data: bytes = b""


class Faults:
    """The library in this process, watching `folder`."""

    def __init__(self, folder: Path) -> None:
        self._library = ctypes.CDLL(os.environ["CAT3D_FAULTS"])
        self._library.faults_counted.restype = ctypes.c_long
        self._library.faults_refused.restype = ctypes.c_char_p
        self._library.faults_watch(str(folder).encode())

    def refuse(self, call: int, error: int = 0) -> None:
        """Refuse the call of this number from now on, 1 for the next one, with this errno; 0 refuses none."""
        self._library.faults_arm(ctypes.c_long(call), error)

    @property
    def counted(self) -> int:
        """Calls since `refuse`."""
        return int(self._library.faults_counted())

    @property
    def refused(self) -> str:
        """What was refused, such as "rename /tmp/a"; empty if nothing was."""
        return os.fsdecode(self._library.faults_refused())

    def record(self, path: Path) -> None:
        """Write every change from now on to `path`, until `stop`; read it back by `events`."""
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        self._library.faults_record(self._file)

    def stop(self) -> None:
        self._library.faults_record(-1)
        os.close(self._file)


def events(path: Path) -> Iterator[Event]:
    """What `Faults.record` wrote, in order."""
    data, at = path.read_bytes(), 0
    head = struct.Struct("=ciiqq")
    while at < len(data):
        kind, first, second, offset, size = head.unpack_from(data, at)
        at += head.size
        parts = []
        for length in (first, second, size):
            parts.append(data[at : at + length])
            at += length
        yield Event(kind.decode(), os.fsdecode(parts[0]), os.fsdecode(parts[1]), offset, parts[2])


class Disk:
    """What is on a disk, and what of it would survive a power cut: the names as they are, since file systems keep a
    journal of them; of a file's content what was synced.

    In a file that was not synced `empty` leaves nothing, `half` the first half, and `kept` all of it: what is lost and
    what is not is up to the moment.
    """

    LOSSES = ("empty", "half", "kept")

    def __init__(self, root: Path) -> None:
        self.root = root
        self.files: dict[str, _File] = {}
        self.folders: set[str] = set()

    def apply(self, event: Event) -> None:
        """One more change."""
        path = event.path
        if event.kind == "m":
            self.folders.add(path)
        elif event.kind in "ct":
            file = self.files.setdefault(path, _File())
            if event.kind == "t":
                file.content, file.synced = bytearray(), b""
        elif event.kind == "w":
            file = self.files.setdefault(path, _File())
            file.content[event.offset : event.offset + len(event.data)] = event.data
        elif event.kind == "l":
            del self.files[path].content[event.offset :]
        elif event.kind == "s":
            if path in self.files:  # else a folder
                self.files[path].synced = bytes(self.files[path].content)
        elif event.kind == "u":
            self.files.pop(path, None)
            self.folders.discard(path)
        elif event.kind == "r":
            self._rename(path, event.other)

    def _rename(self, old: str, new: str) -> None:
        if old in self.files:
            self.files[new] = self.files.pop(old)
            return
        for names in (self.files, self.folders):
            for name in [n for n in names if n == old or n.startswith(old + "/")]:
                moved = new + name[len(old) :]
                if isinstance(names, set):
                    names.remove(name)
                    names.add(moved)
                else:
                    names[moved] = names.pop(name)

    def fail(self, loss: str) -> None:
        """Make the folder as it is found after the power came back."""
        for folder in sorted(self.folders | {str(self.root)}):
            Path(folder).mkdir(parents=True, exist_ok=True)
        for path, file in self.files.items():
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_bytes(file.after(loss))


class _File:
    def __init__(self) -> None:
        self.content, self.synced = bytearray(), b""

    def after(self, loss: str) -> bytes:
        if bytes(self.content) == self.synced or loss == "kept":
            return bytes(self.content)
        return self.synced if loss == "empty" else bytes(self.content[: len(self.content) // 2])
