"""Who may talk to the server of `cat3d view`: pages that it served itself, and further than loopback only those who
know its token."""

from __future__ import annotations

import hmac
import http
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_STARTING = threading.Lock()


@dataclass(frozen=True)
class Guard:
    """token: what a browser must know; None on the loopback address, which only this machine reaches.

    A page of somebody else's that is open in the same browser reaches loopback too. It is kept out by the names that
    its requests carry: `Origin` is the page's own and must be ours, and `Host` must not be a name that was bent to
    127.0.0.1 (DNS rebinding).
    """

    token: str | None = None

    def answer(self, request: Request) -> Response | None:
        """A refusal or a redirection; None for a request that may go on."""
        try:
            host = request.headers.get("Host", "")
            name, port = urlsplit(f"//{host}").hostname, urlsplit(f"//{host}").port or 80
            origin, asked = request.headers.get("Origin"), urlsplit(request.path)
            page = host if origin is None else urlsplit(origin).netloc
            known = SimpleCookie(request.headers.get("Cookie", "")).get(f"cat3d-{port}")
        except (ValueError, LookupError, CookieError):  # nonsense, or a header twice
            return _text(http.HTTPStatus.BAD_REQUEST, "This request cannot be understood.")
        if page != host:
            return _text(http.HTTPStatus.FORBIDDEN, f"A page of {origin} may not look at this scene.")
        if self.token is None:
            if name in LOOPBACK:
                return None
            return _text(http.HTTPStatus.FORBIDDEN, f"This is the viewer of 127.0.0.1, not of {name}.")
        given = parse_qs(asked.query).get("token", [""])[0]
        if _same(given, self.token):
            # Out of the address, where it would stay in the history, into a cookie.
            cookie = f"cat3d-{port}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return _text(http.HTTPStatus.SEE_OTHER, "Welcome.", ("Location", "/"), ("Set-Cookie", cookie))
        if known is not None and _same(known.value, self.token):
            return None
        return _text(http.HTTPStatus.FORBIDDEN, "Open the address that cat3d view printed, with its token.")


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _text(status: http.HTTPStatus, text: str, *headers: tuple[str, str]) -> Response:
    body = (text + "\n").encode()
    every = Headers([*headers, ("Content-Type", "text/plain; charset=utf-8"), ("Content-Length", str(len(body)))])
    return Response(status.value, status.phrase, every, body)


class Server(viser.ViserServer):
    """viser's server without its public tunnel, which any browser could ask for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: a scene is shared by opening the server further, which needs a token."""
        return None


def serve(guard: Guard, host: str, port: int) -> Server:
    """A server, at this port or the next free one, that answers what the guard lets through."""
    with _STARTING, _guarded(guard) as calls:
        server = Server(host=host, port=port, label="cat3d", verbose=False)
    if not calls:  # better none than one that everybody may ask
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} starts its server in a way that cat3d cannot guard.")
    return server


@contextmanager
def _guarded(guard: Guard) -> Iterator[list[int]]:
    """Put the guard before what viser itself does with a request. viser has no place for that, but hands its own check
    to websockets' `serve`. Yields one entry for each server that was started so."""
    original, calls = websockets.asyncio.server.serve, []

    def start(*arguments: Any, process_request: Any, **others: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            return guard.answer(request) or process_request(connection, request)

        calls.append(1)
        return original(*arguments, process_request=check, **others)

    websockets.asyncio.server.serve = start  # type: ignore[assignment, misc]
    try:
        yield calls
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
