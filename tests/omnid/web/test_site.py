"""The form for the token, the places of connections and the list of recordings, without a program."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request

from omnid.errors import OmnidError
from omnid.web import places, recordings, site
from omnid.web.access import COOKIE_S, Access
from omnid.web.places import Acceptor, ConnectionPlaces
from omnid.web.recordings import Recordings, _reason, recordings_routes
from omnid.web.site import Site

TOKEN = "abcdefghijklmnop"


def new_site(secure: bool = False) -> Site:
    access = Access(TOKEN, frozenset(("localhost",)), False, "omnid_1", "")
    return Site("index.html", [], lambda _: "omnid_up 1\n", access, secure)


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


def test_the_newest_recordings_are_listed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (3, 1, 4, 2):
        (tmp_path / f"{number}.mcap").write_bytes(b"x" * number)
        os.utime(tmp_path / f"{number}.mcap", (1000.4 + number, 1000.4 + number))
    (tmp_path / "link.mcap").symlink_to(tmp_path / "1.mcap")
    found = Recordings(tmp_path, tmp_path)
    assert [one.path.name for one in found.list()] == ["4.mcap", "3.mcap", "2.mcap", "1.mcap"]
    monkeypatch.setattr(recordings, "MOST_LISTED", 2)
    described = found.described()
    assert described["folder"] == str(tmp_path)
    assert [(one["name"], one["size_bytes"], one["changed_s"], one["state"]) for one in described["recordings"]] == [
        ("4.mcap", 4, 1004, "no log"),
        ("3.mcap", 3, 1003, "no log"),
    ]
    key = described["recordings"][0]["key"]
    assert len(key) == 24 and key != described["recordings"][1]["key"]
    assert Recordings(tmp_path / "missing", tmp_path).list() == []


class Quick(Recordings):
    """Recordings whose reports are made at once."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, folder)
        self.made = list[str]()
        self.goes_on = asyncio.Event()
        self.goes_on.set()

    async def _make(self, log: Path) -> Path:
        await self.goes_on.wait()
        self.made.append(log.name)
        page = log.with_suffix(f".{len(self.made)}.html")
        page.write_text(log.name)
        return page


def test_a_report_is_made_once_for_each_version_and_the_oldest_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "MOST_REPORTS", 2)
    for name in "abc":
        (tmp_path / f"{name}.mcap").write_bytes(b"")

    async def check() -> None:
        found = Quick(tmp_path)
        keys = {one.path.stem: one.key for one in found.list()}
        first = await found.report(keys["a"])
        assert await found.report(keys["a"]) == first and found.made == ["a.mcap"]
        await found.report(keys["b"])
        assert first.exists()
        await found.report(keys["c"])
        assert not first.exists() and len(list(tmp_path.glob("*.html"))) == 2
        (tmp_path / "c.mcap").write_bytes(b"more")
        await found.report(keys["c"])
        assert found.made == ["a.mcap", "b.mcap", "c.mcap", "c.mcap"]
        found.goes_on.clear()
        waiting = asyncio.create_task(found.report(keys["a"]))
        while not found._busy.locked():
            await asyncio.sleep(0)
        with pytest.raises(OmnidError, match="another report is being made"):
            await found.report(keys["b"])
        with pytest.raises(OmnidError, match="not there any more"):
            await found.report("0")
        found.goes_on.set()
        assert (await waiting).read_text() == "a.mcap"

    asyncio.run(check())


def test_a_report_is_answered_as_a_page_or_as_json(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"")

    async def check() -> None:
        found = Quick(tmp_path)
        key = found.list()[0].key
        report = recordings_routes(found)[1].endpoint  # type: ignore[attr-defined]
        for method, asked, status, words in (
            ("POST", key, 200, b'{"done":true,"text":""}'),
            ("POST", "0", 409, b'{"done":false,'),
            ("GET", key, 200, None),
        ):
            scope = {"type": "http", "method": method, "path": "/", "headers": [], "path_params": {"key": asked}}
            answer = await report(Request(scope))
            assert answer.status_code == status and (words is None or answer.body.startswith(words))
        assert "sandbox" in answer.headers["content-security-policy"]

    asyncio.run(check())


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("open(page, 'w').write('it')", ""),
        ("", "failed (exit code 0)"),
        ("open(page, 'w').write('it'); sys.exit(1)", "failed (exit code 1)"),
        ("print('one; omnid: two', 'omnid: three', sep=chr(10), file=sys.stderr); sys.exit(2)", "omnid: three"),
    ],
)
def test_a_report_is_there_where_its_program_ends_well_and_has_made_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, words: str
) -> None:
    code = f"import os, sys; page = sys.argv[-1]; {program}"
    monkeypatch.setattr(recordings, "python", lambda *given: [sys.executable, "-S", "-c", code, *given])
    (tmp_path / "a.mcap").write_bytes(b"")
    found = Recordings(tmp_path, tmp_path)
    made = found.report(found.list()[0].key)
    if words:
        with pytest.raises(OmnidError, match=re.escape(words)):
            asyncio.run(made)
    else:
        assert asyncio.run(made).read_text() == "it"


def test_a_report_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "REPORT_S", 0.001)
    (tmp_path / "a.mcap").write_bytes(b"")
    found, start, processes = Recordings(tmp_path, tmp_path), asyncio.create_subprocess_exec, list[Any]()

    async def kept(*words: str, **settings: Any) -> Any:
        processes.append(await start(*words, **settings))
        return processes[-1]

    with monkeypatch.context() as patched:
        patched.setattr(asyncio, "create_subprocess_exec", kept)
        with pytest.raises(OmnidError, match=r"not ready within 0\.001 s"):
            asyncio.run(found.report(found.list()[0].key))
    assert processes[0].returncode == -signal.SIGKILL


def test_the_reason_is_the_last_line_where_the_user_can_correct_it() -> None:
    assert _reason(2, "one\na half\nomnid: two\x1b\n", "a") == r"omnid: two\x1b"
    for code, messages in ((2, ""), (1, "a traceback"), (-9, "x"), (None, "x")):
        assert _reason(code, messages, "a\x1b") == (
            rf"omnid: the report about a\x1b failed (exit code {code}): run `omnid report` on it to see why"
        )
