"""Who may talk to the viewer: its own pages, and further than loopback only those who know the token."""

from __future__ import annotations

import http.client
from collections.abc import Iterator

import pytest
from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

from flows.viewer import guard
from flows.viewer.guard import Guard, Server, serve
from tests.e2e.browser import free_port

TOKEN = "r1ght"
OPEN, LOCKED = Guard(), Guard(TOKEN)


def status(by: Guard, host: str = "127.0.0.1:8080", path: str = "/", **headers: str) -> int | None:
    answer = by.answer(Request(path, Headers([("Host", host), *headers.items()])))
    return None if answer is None else answer.status_code


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080"])
def test_loopback_is_open_to_its_own_pages(host: str) -> None:
    assert status(OPEN, host) is None
    assert status(OPEN, host, Origin=f"http://{host}") is None


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:9999", "null", "http://[", "https://"])
def test_pages_of_others_are_kept_out(origin: str) -> None:
    assert status(OPEN, Origin=origin) in (400, 403)
    assert status(LOCKED, Origin=origin, Cookie=f"cat3d-8080={TOKEN}") in (400, 403)


@pytest.mark.parametrize("host", ["evil.example:8080", "127.0.0.1.evil.example", "", "127.0.0.1:many", "192.168.0.7"])
def test_names_bent_to_loopback_are_kept_out(host: str) -> None:
    assert status(OPEN, host) in (400, 403)


def test_a_request_that_says_who_twice_is_refused() -> None:
    twice = Headers([("Host", "127.0.0.1:8080"), ("Host", "evil.example")])
    answer = OPEN.answer(Request("/", twice))
    assert answer is not None
    assert answer.status_code == 400


def test_a_token_is_asked_for_and_becomes_a_cookie() -> None:
    host = "machine:8080"
    assert status(LOCKED, host) == 403
    assert status(LOCKED, host, "/?token=wr0ng") == 403
    assert status(LOCKED, host, "/?token=") == 403
    assert status(LOCKED, host, Cookie="cat3d-8080=wr0ng") == 403
    assert status(LOCKED, host, Cookie=f"cat3d-9090={TOKEN}") == 403  # another viewer's
    answer = LOCKED.answer(Request(f"/?token={TOKEN}", Headers([("Host", host)])))
    assert answer is not None
    assert (answer.status_code, answer.headers["Location"]) == (303, "/")
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert status(LOCKED, host, Cookie=cookie.partition(";")[0]) is None


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = serve(LOCKED, "127.0.0.1", free_port())
    yield made
    made.stop()


def get(port: int, path: str, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_the_server_itself_asks_for_the_token(server: Server) -> None:
    port = server.get_port()
    assert get(port, "/") == (403, "Open the address that cat3d view printed, with its token.\n")
    assert get(port, f"/?token={TOKEN}")[0] == 303
    known = {"Cookie": f"cat3d-{port}={TOKEN}"}
    found, page = get(port, "/", **known)
    assert found == 200
    assert "<html" in page
    assert get(port, "/%2e%2e/secret", **known)[0] == 404
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{port}")
    with connect(f"ws://127.0.0.1:{port}", additional_headers=known):
        pass  # let in


def test_nobody_can_open_a_public_tunnel(server: Server) -> None:
    assert server.request_share_url() is None


def test_a_server_that_cannot_be_guarded_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a viser that starts its server in another way."""
    stopped = []

    class Unguarded:
        def __init__(self, **others: object) -> None: ...

        def stop(self) -> None:
            stopped.append(1)

    monkeypatch.setattr(guard, "Server", Unguarded)
    with pytest.raises(RuntimeError, match="cannot guard"):
        serve(OPEN, "127.0.0.1", free_port())
    assert stopped
    assert websockets_server.serve.__module__.startswith("websockets")
