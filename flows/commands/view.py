"""`cat3d view`: a scene in the browser."""

from __future__ import annotations

import time
from pathlib import Path

from flows.errors import InputError
from flows.progress import console


def view_command(path: Path, run: str | None, port: int) -> None:
    """Serve a store or a folder of stores on the loopback address until Ctrl-C.

    Raises InputError where there is nothing to see.
    """
    try:
        from flows.viewer.server import Viewer
    except ImportError as error:
        raise InputError(f"The viewer needs viser ({error}); type  pip install 'cat3d[view]'") from None
    if not 0 < port < 65536:
        raise InputError(f"--port is {port}; it must lie between 1 and 65535.")
    viewer = Viewer(path, run, port)
    if viewer.port != port:
        console.print(f"The port {port} is taken; this is the next free one.")
    console.print(f"http://127.0.0.1:{viewer.port}  shows {viewer.first}; Ctrl-C ends it.")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        console.print("Ended.")
    finally:
        viewer.stop()
