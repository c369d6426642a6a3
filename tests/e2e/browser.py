"""A headless Chromium, driven over its own debugging protocol."""

from __future__ import annotations

import base64
import ctypes
import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

#: Software WebGL (SwiftShader); no connection but those of the page.
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-sandbox",
    "--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--force-device-scale-factor=1",
    "--disable-backgrounding-occluded-windows", "--disable-renderer-backgrounding", "--remote-debugging-port=0",
)  # fmt: skip
PATIENCE = 240.0
"""Seconds: with software WebGL on a busy machine a frame may take some."""


def free_port() -> int:
    """A port of the loopback address that nothing listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Tab:
    """One page, or the browser itself."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None, open_timeout=PATIENCE)
        self._number = 0

    def close(self) -> None:
        """Close the page."""
        self.call("Page.close")
        self._socket.close()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to one command of the debugging protocol."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]  # type: ignore[no-any-return]

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression, a promise's too."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def screenshot(self, path: Path) -> np.ndarray:
        """(h, w, 3) uint8 of the window, also written to a PNG."""
        from flows.media.images import read_image

        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return read_image(path)[0][..., :3]

    def drag(self, start: tuple[float, float], by: tuple[float, float], steps: int = 6) -> None:
        """Press the left button at a point of the window, move and let go."""
        self._mouse("mousePressed", *start)
        for i in range(1, steps + 1):
            self._mouse("mouseMoved", start[0] + by[0] * i / steps, start[1] + by[1] * i / steps)
        self._mouse("mouseReleased", start[0] + by[0], start[1] + by[1])

    def click(self, x: float, y: float) -> None:
        """Go to a point of the window and click it."""
        self._mouse("mouseMoved", x, y, buttons=0)
        self._mouse("mousePressed", x, y)
        self._mouse("mouseReleased", x, y)

    def _mouse(self, kind: str, x: float, y: float, buttons: int = 1) -> None:
        button = "left" if buttons else "none"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=buttons)

    def resize(self, width: int, height: int) -> None:
        """Give the page this many pixels."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)


class Browser:
    """A running Chromium."""

    def __init__(self, port: int) -> None:
        self._base = f"127.0.0.1:{port}"
        with urllib.request.urlopen(f"http://{self._base}/json/version", timeout=PATIENCE) as answer:
            self._whole = Tab(json.load(answer)["webSocketDebuggerUrl"])

    def open(self, url: str) -> Tab:
        """A new window at this address."""
        target = self._whole.call("Target.createTarget", url=url, newWindow=True)["targetId"]
        return Tab(f"ws://{self._base}/devtools/page/{target}")


@contextmanager
def chromium(profile: Path, width: int = 800, height: int = 600) -> Iterator[Browser]:
    """A browser with windows of this size; skips the test where there is none."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("No Chromium on this machine; install the package chromium to run this test.")
    command = [program, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True, preexec_fn=_end_with_us
    )
    told = profile / "DevToolsActivePort"
    try:
        until(lambda: told.exists() and told.read_text().count("\n"), PATIENCE)
        yield Browser(int(told.read_text().split()[0]))
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=60)


def _end_with_us() -> None:
    """Ask Linux to end the browser when the process that started it is killed: drawing without a graphics card takes
    a whole core."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def until(done: Any, seconds: float = PATIENCE, every: float = 0.2) -> Any:
    """What `done` returns once that is true; AssertionError after so many seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = done()
        if found:
            return found
        time.sleep(every)
    raise AssertionError(f"Not within {seconds} s.")
