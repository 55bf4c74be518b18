"""Requests that enter and requests that do not, as ASGI scopes; and the file of the token."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from starlette.requests import HTTPConnection

from omnid.errors import OmnidError
from omnid.web.access import Access, Role, token_of

TOKEN, STOP_TOKEN = "abcde-fghjk-mnpqr-stuvw", "stop-stop-stop-stop"
LOCAL = Access(TOKEN, frozenset(("localhost", "127.0.0.1", "[::1]")), False, "omnid_8447")
NETWORK = Access(TOKEN, frozenset(("localhost", "rover", "rover.local")), True, "omnid_8447")
BOTH = Access(TOKEN, LOCAL.hosts, False, "omnid_8447", STOP_TOKEN)
HOST = "127.0.0.1:8447"
COOKIE = {"cookie": f"other=1; omnid_8447={LOCAL.new_cookie(Role.DRIVE)}"}
BEARER = {"authorization": f"Bearer {TOKEN}"}
OWN = {"origin": f"http://{HOST}"}


def reason(access: Access, *headers: dict[str, str], path: str = "/metrics", method: str = "GET") -> str:
    """Return the reason of a refusal, empty where the request enters; later headers replace earlier ones."""
    merged = {"host": HOST}
    for more in headers:
        merged |= more
    lines = [(name.encode(), value.encode("latin-1")) for name, value in merged.items() if value]
    scope = {"type": "http", "path": path, "headers": lines, "method": method}
    return access.refusal(HTTPConnection(scope))


@pytest.mark.parametrize(
    ("access", "host", "enters"),
    [
        (LOCAL, HOST, True),
        (LOCAL, "localhost", True),
        (LOCAL, "[::1]:8447", True),
        (LOCAL, "LOCALHOST:9000", True),
        (LOCAL, "evil.example", False),
        (LOCAL, "192.168.1.7:8447", False),
        (LOCAL, "127.0.0.1.evil.example", False),
        (LOCAL, "localhost@evil.example", False),
        (LOCAL, "", False),
        (LOCAL, "a b", False),
        (NETWORK, "192.168.1.7:8447", True),
        (NETWORK, "[fe80::1]:8447", True),
        (NETWORK, "rover.local:8447", True),
        (NETWORK, "evil.example:8447", False),
        (NETWORK, "192.168.1.7.evil.example", False),
    ],
)
def test_only_own_names_are_answered(access: Access, host: str, enters: bool) -> None:
    assert reason(access, BEARER, {"host": host}) == ("" if enters else "unknown host")


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, "no token"),
        (COOKIE, ""),
        (BEARER, ""),
        ({"authorization": "Bearer wrong-wrong-wrong"}, "wrong token"),
        ({"authorization": f"Basic {TOKEN}"}, "wrong token"),
        ({"authorization": "Bearer "}, "wrong token"),
        ({"authorization": "Bearer \xe4\xf6"}, "wrong token"),
        ({**COOKIE, "authorization": "Bearer wrong"}, "wrong token"),
        ({"cookie": f"omnid_8447={TOKEN}"}, "wrong token"),
        ({"cookie": "omnid_8447="}, "wrong token"),
        ({"cookie": "omnid_8447=\xe4"}, "wrong token"),
        ({"cookie": f"omnid_8447={BOTH.new_cookie(Role.STOP)}"}, "wrong token"),
        ({"cookie": f"omnid_8447={LOCAL.new_cookie(Role.STOP)}"}, "wrong token"),
        ({"cookie": f"omnid_1={LOCAL.new_cookie(Role.DRIVE)}"}, "no token"),
        ({"cookie": ";;=;"}, "no token"),
    ],
)
def test_the_token_or_its_cookie_is_needed(headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, headers) == expected
    assert reason(LOCAL, headers, OWN, path="/live") == expected


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        (OWN, ""),
        ({"origin": f"https://{HOST}"}, ""),
        ({"origin": "http://evil.example"}, "cross-site"),
        ({"origin": "http://127.0.0.1:3000"}, "cross-site"),
        ({"origin": "null"}, "cross-site"),
        ({"origin": f"http://{HOST}.evil.example"}, "cross-site"),
        ({"origin": f"ftp://{HOST}"}, "cross-site"),
        ({}, "no origin"),
        (BEARER, ""),
        ({**OWN, "sec-fetch-site": "same-origin"}, ""),
        ({**OWN, "sec-fetch-site": "same-site"}, "cross-site"),
        ({**OWN, "sec-fetch-site": "cross-site"}, "cross-site"),
        ({**BEARER, "origin": "http://evil.example"}, "cross-site"),
    ],
)
def test_commands_come_from_the_own_page(headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, COOKIE, headers, method="POST", path="/stop") == expected


@pytest.mark.parametrize(("path", "expected"), [("/", ""), ("/metrics", "cross-site"), ("/static/a.js", "cross-site")])
def test_other_sites_may_only_link_to_the_page(path: str, expected: str) -> None:
    assert reason(LOCAL, COOKIE, {"sec-fetch-site": "cross-site"}, path=path) == expected


def test_the_token_for_stops_may_see_and_stop_and_nothing_else() -> None:
    cookie = {"cookie": f"omnid_8447={BOTH.new_cookie(Role.STOP)}", **OWN}
    for headers in ({"authorization": f"Bearer {STOP_TOKEN}"}, cookie):
        for path, method in (("/", "GET"), ("/metrics", "GET"), ("/stop", "POST"), ("/logout", "POST")):
            assert reason(BOTH, headers, path=path, method=method) == ""
        assert reason(BOTH, headers, path="/live") == ""
        for path in ("/arm", "/route", "/navigation", "/map", "/drive", "/goal", "/x/stop"):
            assert reason(BOTH, headers, path=path, method="POST") == "stop only"
    assert reason(BOTH, COOKIE, OWN, path="/arm", method="POST") == ""
    assert BOTH.role_of(f" {TOKEN}\n") is Role.DRIVE and BOTH.role_of(STOP_TOKEN) is Role.STOP
    assert LOCAL.role_of("") is None, "without a token for stops an empty one is none"


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        *((f"{TOKEN}\n", mode, "chmod 600") for mode in (0o644, 0o604, 0o602, 0o601)),
        *((text, 0o600, "16 to 256") for text in ("short\n", "", "a" * 300, "has a space in it here\n")),
    ],
)
def test_unfit_token_files_are_refused(tmp_path: Path, text: str, mode: int, message: str) -> None:
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(OmnidError, match=message):
        token_of(path)
    with pytest.raises(OmnidError, match="cannot be used"):
        token_of(tmp_path / "missing" / "token")
