"""`cat3d view`: a scene in the browser."""

from __future__ import annotations

import socket
import time
from pathlib import Path

from flows.errors import InputError
from flows.progress import console

#: Hosts that mean every address of this machine, which is for the user to ask for.
EVERYWHERE = ("0.0.0.0", "::")  # nosec B104


def view_command(path: Path, run: str | None, port: int, host: str = "127.0.0.1") -> None:
    """Serve a store or a folder of stores until Ctrl-C: on the loopback address, or on another one behind a token.

    Raises InputError where there is nothing to see or the address is none of this machine.
    """
    try:
        from flows.viewer.server import Viewer
    except ImportError as error:
        raise InputError(f"The viewer needs viser ({error}); type  pip install 'cat3d[view]'") from None
    if not 0 < port < 65536:
        raise InputError(f"--port is {port}; it must lie between 1 and 65535.")
    _check(host)
    viewer = Viewer(path, run, port, host)
    if viewer.port != port:
        console.print(f"The port {port} is taken; this is the next free one.")
    name = socket.gethostname() if host in EVERYWHERE else f"[{host}]" if ":" in host else host
    query = f"/?token={viewer.token}" if viewer.token else ""
    console.print(f"http://{name}:{viewer.port}{query}  shows {viewer.first}; Ctrl-C ends it.", soft_wrap=True)
    if viewer.token:
        console.print("Whoever has this address sees the scene, and nothing is encrypted on the way: keep it private.")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        console.print("Ended.")
    finally:
        viewer.stop()


def _check(host: str) -> None:
    """Raises InputError for an address that nothing can be served on: viser would try a thousand ports."""
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.bind(address)
    except OSError as error:
        raise InputError(
            f"--host is {host}, which is no address of this machine ({error.strerror}); 0.0.0.0 means all of them."
        ) from None
