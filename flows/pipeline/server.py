"""The one Prefect server of a command: started when needed, shared by all workers, stopped with the command.

Where PREFECT_API_URL is set, the user's own server is used and left alone. Otherwise a server is started on a free
loopback port. Prefect's own temporary server outlives a SIGTERM and each worker process would start another; this one
dies with its parent however the parent dies (Linux parent-death signal), and its address is in the environment that
workers inherit.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from cat3d_core.cpu_library import cache_folder
from flows.disk import naming_full_disk
from flows.errors import ServerError
from schemas.documents import write_bytes

START_TIMEOUT_S = 120.0
_PR_SET_PDEATHSIG = 1


def quiet_environment(home: Path) -> dict[str, str]:
    """Settings for Prefect without telemetry, UI blocks or chatter, with its state in `home`."""
    return {
        "PREFECT_HOME": str(home),
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_LOGGING_LEVEL": os.environ.get("PREFECT_LOGGING_LEVEL", "CRITICAL"),
        "PREFECT_LOGGING_TO_API_ENABLED": "false",
        "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": "false",
        "PREFECT_SERVER_UI_ENABLED": os.environ.get("PREFECT_SERVER_UI_ENABLED", "false"),
        "PREFECT_TASKS_DEFAULT_NO_CACHE": "true",  # the store is the truth of what is done
        "PREFECT_TASKS_DEFAULT_PERSIST_RESULT": "false",
        # A company's proxy does not know this machine's own addresses.
        **dict.fromkeys(("NO_PROXY", "no_proxy"), _without_proxy()),
    }


def _without_proxy() -> str:
    """The hosts that are reached directly: those of the environment, and this machine."""
    given = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    return ",".join([*filter(None, (host.strip() for host in given.split(","))), "127.0.0.1", "localhost"])


@contextlib.contextmanager
def prefect_server(home: Path) -> Iterator[str]:
    """Yield the API address of a running server; must be entered before any flow is run.

    home: folder for the server's database (created). Raises ServerError when no server answers in START_TIMEOUT_S, and
    StoreError for whatever fails in it because the disk is full. SIGTERM is turned into SystemExit(143) while the
    server runs, so that `finally` blocks are reached.
    """
    with naming_full_disk(home), _server(home) as url:
        yield url


@contextlib.contextmanager
def _server(home: Path) -> Iterator[str]:
    given = os.environ.get("PREFECT_API_URL")
    if given:
        _wait_until_healthy(given, None, 10.0)
        yield given
        return
    home.mkdir(parents=True, exist_ok=True)
    environment = quiet_environment(home)
    # The user's own settings of Prefect (a base path, a database, a profile) are for the user's server.
    theirs = [name for name in os.environ if name.startswith("PREFECT_") and name not in environment]
    before = {name: os.environ.get(name) for name in [*environment, *theirs, "PREFECT_API_URL"]}
    for name in theirs:
        del os.environ[name]
    os.environ.update(environment)
    template, database = _template_path(), home / "prefect.db"
    fresh = not database.exists()
    if fresh and template is not None and template.exists():
        write_bytes(database, template.read_bytes())  # whole or, where the disk is full, not at all
    port = _free_port()
    url = f"http://127.0.0.1:{port}/api"
    log_path = home / "server.log"
    with open(log_path, "ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app", "--host",
             "127.0.0.1", "--port", str(port), "--log-level", "error", "--lifespan", "on"],
            stdout=log, stderr=log, stdin=subprocess.DEVNULL, preexec_fn=_die_with_parent,
        )  # fmt: skip
    previous = _sigterm_exits()
    try:
        try:
            _wait_until_healthy(url, process, START_TIMEOUT_S)
        except ServerError as error:
            if fresh:  # half made, it would end every later server too
                _stop(process)
                for part in home.glob(f"{database.name}*"):
                    part.unlink()
            raise ServerError(f"{error} Its log is {log_path}.") from None
        if template is not None:
            _save_template(database, template)
        os.environ["PREFECT_API_URL"] = url
        with _settings_of_environment():
            yield url
    finally:
        _stop(process)
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _settings_of_environment() -> Iterator[None]:
    """Prefect reads its environment when it is imported; where that has happened already, make it read again."""
    if "prefect" not in sys.modules:
        yield
        return
    from prefect.context import SettingsContext, get_settings_context
    from prefect.settings import Settings

    profile = get_settings_context().profile
    with SettingsContext(profile=profile, settings=Settings()):
        yield


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    # Ctrl-C goes to the whole foreground group: the server must outlive the flow that is winding down.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _sigterm_exits():
    def leave(_signum, _frame):
        for child in multiprocessing.active_children():  # a pool would wait for their work before it lets us go
            child.terminate()
        raise SystemExit(143)

    try:
        return signal.signal(signal.SIGTERM, leave)
    except ValueError:  # not in the main thread: the embedding program has its own handling
        return None


def _free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def _wait_until_healthy(url: str, process: subprocess.Popen | None, timeout_s: float) -> None:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if process is not None and process.poll() is not None:
            raise ServerError(f"The Prefect server ended at once with exit code {process.returncode}.")
        try:
            with opener.open(f"{url.rstrip('/')}/health", timeout=2) as answer:
                if answer.status == 200:
                    return
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    raise ServerError(f"No Prefect server answered at {url} within {timeout_s:.0f} s.")


def _stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _template_path() -> Path | None:
    """Where the empty database is kept for the next server; None where nothing can be kept."""
    import importlib.metadata

    try:
        return cache_folder() / f"prefect-{importlib.metadata.version('prefect')}.db"
    except OSError:
        return None


def _save_template(database: Path, template: Path) -> None:
    """Keep a copy of the freshly migrated database: the next new home then starts twice as fast."""
    if template.exists():
        return
    with contextlib.suppress(OSError, sqlite3.Error):
        template.parent.mkdir(parents=True, exist_ok=True)
        part = template.with_suffix(f".{os.getpid()}.part")
        with contextlib.closing(sqlite3.connect(database)) as connection:
            connection.execute("VACUUM INTO ?", (str(part),))
        os.replace(part, template)
