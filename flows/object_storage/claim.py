"""Who may write a folder on object storage: one small object, changed by conditional writes alone.

It also says which working copy was copied there last, how often that happened, and whether the last time was completed.
"""

from __future__ import annotations

import json
import platform
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError, PreconditionError
from obstore.store import S3Store

from flows.errors import InputError, WorkerError
from flows.locks import lives, this_process
from flows.progress import console

NAME = ".cat3d.json"
#: A holder shows so often that it lives; one that has not for three times as long is taken for dead.
BEAT_S = 20.0


@dataclass(frozen=True)
class State:
    """What the object holds. writer: the working copy that was copied there last; generation: how often one was.
    touched: what a copying that was begun and not completed may have changed."""

    writer: str = ""
    generation: int = 0
    touched: tuple[str, ...] = ()
    holder: str = ""
    beat: int = 0

    @property
    def version(self) -> str:
        """Differs whenever the folder may have changed."""
        return f"{self.writer} {self.generation} {'begun' if self.touched else 'complete'}"


def read_state(store: S3Store) -> tuple[State, str | None]:
    """The folder's state and its tag; the first one's, and None, where nothing was ever copied there."""
    try:
        found = obstore.get(store, NAME)
        document = json.loads(bytes(found.bytes()))
        state = State(
            str(document["writer"]), int(document["generation"]), tuple(map(str, document["touched"])),
            str(document["holder"]), int(document["beat"]),
        )  # fmt: skip
        return state, found.meta["e_tag"]
    except (NotFoundError, FileNotFoundError):
        return State(), None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{NAME} in the bucket's folder is damaged ({error}); delete it to begin anew.") from None


class Claim:
    """The right to write the folder, held from `take` to `release`; a thread shows that the holder lives."""

    def __init__(self, store: S3Store, address: str) -> None:
        self.store, self.address = store, address
        self.me = this_process()
        self.state = State()
        self.tag: str | None = None
        self.lock, self.over = threading.RLock(), threading.Event()
        self.thread: threading.Thread | None = None

    def take(self) -> None:
        """Become the holder. Raises InputError while another command is."""
        self.state, self.tag = read_state(self.store)
        if self.state.holder and not self._is_dead():
            raise InputError(
                f"Another cat3d command ({self.state.holder}) is writing {self.address}; wait for it, or choose "
                "another --out."
            )
        try:
            self.change(holder=self.me)
        except WorkerError:
            raise InputError(f"Another cat3d command has just begun to write {self.address}; wait for it.") from None
        self.thread = threading.Thread(target=self._beat, daemon=True)
        self.thread.start()

    def change(self, **changes: Any) -> None:
        """Write the state anew. Raises WorkerError where another command has taken the folder over meanwhile."""
        with self.lock:
            state = replace(self.state, **changes)
            mode: Any = "create" if self.tag is None else {"e_tag": self.tag}
            try:
                result = obstore.put(self.store, NAME, json.dumps(asdict(state)).encode(), mode=mode)
            except (PreconditionError, AlreadyExistsError):
                if read_state(self.store)[0] != state:  # else it was written, and only the answer was lost
                    raise WorkerError(
                        f"Another cat3d command has taken {self.address} over, as this one showed no sign of life; "
                        "run it again when that one is done."
                    ) from None
                self.tag = read_state(self.store)[1]
            else:
                self.tag = result["e_tag"]
            self.state = state

    def release(self) -> None:
        """Let others write."""
        self.over.set()
        if self.thread is not None:
            self.thread.join()
        self.change(holder="")

    def _beat(self) -> None:
        while not self.over.wait(BEAT_S):
            with suppress(BaseError, WorkerError, OSError):  # the next copying says it, if it lasts
                self.change(beat=self.state.beat + 1)

    def _is_dead(self) -> bool:
        """Whether the holder of the state that was read is gone: looked up on this machine, waited for on others."""
        pid, _, host = self.state.holder.removeprefix("process ").partition(" of ")
        if host == platform.node():
            return not (pid.isdigit() and lives(int(pid)))
        console.print(f"Waiting to see whether {self.state.holder}, which last wrote {self.address}, still lives.")
        seen, deadline = self.tag, time.monotonic() + 3 * BEAT_S
        while time.monotonic() < deadline:
            time.sleep(min(1.0, BEAT_S / 4))
            self.state, self.tag = read_state(self.store)
            if self.tag != seen:
                return not self.state.holder
        return True
