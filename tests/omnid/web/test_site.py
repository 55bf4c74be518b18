"""The form for the token, the places of connections and the list of recordings, without a program."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence
from typing import Any

import pytest
from starlette.requests import Request

from omnid.web import places, site
from omnid.web.access import COOKIE_S, Access
from omnid.web.places import Acceptor, ConnectionPlaces
from omnid.web.site import Site

TOKEN = "abcdefghijklmnop"


def new_site(secure: bool = False) -> Site:
    access = Access(TOKEN, frozenset(("localhost",)), False, "omnid_1", "")
    return Site([], lambda _: "omnid_up 1\n", access, secure)


def ask(
    found: Site, method: str, path: str, chunks: Sequence[bytes] = (b"",), query: bytes = b"", cookie: str = ""
) -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of the answer to a request whose body comes in chunks."""
    sent: list[dict[str, Any]] = []
    messages = [
        {"type": "http.request", "body": chunk, "more_body": k < len(chunks) - 1} for k, chunk in enumerate(chunks)
    ]

    async def receive() -> dict[str, Any]:
        if not messages:
            await asyncio.Event().wait()
        return messages.pop(0)

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [(b"host", b"localhost"), (b"origin", b"http://localhost"), (b"cookie", cookie.encode())]
    scope = {
        "type": "http",
        "method": method,
        "path": path,
        "root_path": "",
        "scheme": "http",
        "query_string": query,
        "headers": headers,
        "http_version": "1.1",
        "client": ("127.0.0.1", 1),
        "server": ("localhost", 80),
    }
    asyncio.run(found.guard(scope, receive, send))
    found_headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], found_headers, b"".join(bytes(message.get("body", b"")) for message in sent[1:])


@pytest.mark.parametrize("secure", [False, True])
def test_a_token_is_taken_for_a_cookie_that_scripts_cannot_read(secure: bool) -> None:
    found = new_site(secure)
    for status, headers, _ in (
        ask(found, "POST", "/login", [b"tok", f"en={TOKEN}".encode()]),
        ask(found, "GET", "/", query=f"token={TOKEN}".encode()),
    ):
        set_cookie = headers["set-cookie"].lower()
        assert status == 303 and headers["location"] == "/"
        assert "httponly" in set_cookie and "samesite=lax" in set_cookie and f"max-age={COOKIE_S}" in set_cookie
        assert ("secure" in set_cookie) == secure
    cookie = headers["set-cookie"].split(";")[0]
    status, _, body = ask(found, "GET", "/", cookie=cookie)
    assert status == 200 and b"page.js" in body
    status, headers, _ = ask(found, "POST", "/logout", cookie=cookie)
    gone = headers["set-cookie"].lower()
    assert status == 303 and "httponly" in gone and ("secure" in gone) == secure
    assert ask(found, "GET", "/", cookie=cookie)[0] == 401
    assert found.guard.refused["wrong token"] == 0


def test_wrong_tokens_are_counted_and_forms_bounded() -> None:
    found = new_site()
    for count, chunks in enumerate(([b"token=wrong"], [b""], [b"token=wrong&token=" + TOKEN.encode(), b""]), 1):
        assert ask(found, "POST", "/login", chunks)[0] == 401
        assert found.guard.refused["wrong token"] == count
    status, _, body = ask(found, "GET", "/", query=b"token=wrong")
    assert status == 401 and b"token" in body and found.guard.refused["wrong token"] == 4
    form = f"token={TOKEN}&x=".encode()
    assert ask(found, "POST", "/login", [form, b"x" * (1024 - len(form))])[0] == 303
    assert ask(found, "POST", "/login", [form, b"x" * (1025 - len(form)), b""])[0] == 413
    assert ask(found, "GET", "/")[0] == 401
    # The first of several tokens counts, and a form of many fields is no token.
    assert ask(found, "POST", "/login", [f"token={TOKEN}&token=wrong".encode()])[0] == 303
    assert ask(found, "POST", "/login", [form + b"y&a=1&b=2"])[0] == 303
    assert ask(found, "POST", "/login", [form + b"y&a=1&b=2&c=3"])[0] == 413


def test_a_form_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site, "_FORM_S", 0.005)
    found = new_site()

    async def receive() -> dict[str, Any]:
        return await asyncio.Event().wait()  # type: ignore[return-value]

    answer = asyncio.run(found._login(Request({"type": "http", "method": "POST", "path": "/", "headers": []}, receive)))
    assert answer.status_code == 408


def test_connections_that_have_ended_leave_their_places_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MOST_CONNECTIONS", 3)

    async def check() -> None:
        found = ConnectionPlaces()
        found.free_one()  # there is none
        assert found.lost == 0
        ended, opening, new = (found.admit((host, 1)) for host in ("a", "b", "c"))
        done, waits = asyncio.Event(), asyncio.Event()
        done.set()
        ended.opening = asyncio.create_task(done.wait())  # type: ignore[arg-type]
        opening.opening = asyncio.create_task(waits.wait())  # type: ignore[arg-type]
        await ended.opening
        assert [place.host for place in (ended, opening, new)] == ["a", "b", "c"]
        assert [place.is_left for place in (ended, opening, new)] == [True, False, False]
        found.admit(("d", 1))
        assert len(found) == 3 and found.lost == 0 and ended not in found._places.values()
        # Where all are known, the oldest of the address with most of them goes; else one that is not.
        for address in (["b", 1], ("c", 1), ("d", 1), ("nowhere", 1), None, "b1"):
            found.know(address)
        assert all(place.is_known for place in found._places.values())
        found.admit(("e", 1))
        assert found.lost == 1 and opening not in found._places.values() and len(found) == 3
        with pytest.raises(asyncio.CancelledError):
            await opening.opening
        found.admit(("f", 1))
        assert [host for host, _ in found._places] == ["c", "d", "f"] and found.lost == 2

    asyncio.run(check())


def test_a_new_connection_gets_the_place_of_a_silent_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MOST_CONNECTIONS", 2)

    class Echo(asyncio.Protocol):
        def connection_made(self, transport: Any) -> None:
            self._transport = transport

        def data_received(self, data: bytes) -> None:
            self._transport.write(data)

    async def check() -> None:
        listener, found = socket.create_server(("127.0.0.1", 0)), ConnectionPlaces()
        acceptor = Acceptor(listener, Echo, None, found)
        address = listener.getsockname()
        readers = []
        for number in range(4):
            reader, writer = await asyncio.open_connection(*address)
            writer.write(b"%d" % number)
            assert await reader.readexactly(1) == b"%d" % number
            readers.append((reader, writer))
        assert len(found) == 2 and found.lost == 2
        for reader, _ in readers[:2]:
            with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
                await reader.readexactly(1)
        places_left = list(found._places.values())
        assert [place.host for place in places_left] == ["127.0.0.1"] * 2 and all(port for _, port in found._places)
        assert not any(place.is_left for place in places_left)
        for _, writer in readers:
            writer.close()
        while not all(place.is_left for place in places_left):
            await asyncio.sleep(0)
        acceptor.close()
        await acceptor.wait_closed()
        assert acceptor._accepting.cancelled()
        listener.close()

    asyncio.run(check())


def test_where_the_system_has_no_more_files_a_silent_connection_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "_RETRY_S", 0.0)

    async def check() -> None:
        found, listener = ConnectionPlaces(), socket.socket()  # does not listen, so accept raises OSError
        place = found.admit(("a", 1))
        acceptor = Acceptor(listener, asyncio.Protocol, None, found)
        while len(found):
            await asyncio.sleep(0)
        assert found.lost == 1 and not place.is_known and not acceptor._accepting.done()
        acceptor.close()
        await acceptor.wait_closed()
        listener.close()

    asyncio.run(check())
