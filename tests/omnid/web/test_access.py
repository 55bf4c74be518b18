"""Requests that enter and requests that do not, as ASGI scopes; and the file of the token."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from omnid.errors import OmnidError
from omnid.web.access import COOKIE_S, MOST_ENDED, Access, Role, new_token, token_of

TOKEN = "abcde-fghjk-mnpqr-stuvw"
LOCAL = Access(TOKEN, frozenset(("localhost", "127.0.0.1", "[::1]")), False, "omnid_8447")
NETWORK = Access(TOKEN, frozenset(("localhost", "rover", "rover.local")), True, "omnid_8447")
HOST = "127.0.0.1:8447"
COOKIE = {"cookie": f"other=1; omnid_8447={LOCAL.new_cookie(Role.ALL)}"}
BEARER = {"authorization": f"Bearer {TOKEN}"}
OWN = {"origin": f"http://{HOST}"}


def reason(
    access: Access, *headers: dict[str, str], path: str = "/metrics", method: str = "GET", kind: str = "http"
) -> str:
    """Return the reason of a refusal, empty where the request enters; later headers replace earlier ones."""
    merged = {"host": HOST}
    for more in headers:
        merged |= more
    scope: dict[str, Any] = {
        "type": kind,
        "path": path,
        "method": method,
        "headers": [(k.encode(), v.encode("latin-1")) for k, v in merged.items() if v],
    }
    refusal = access.refusal(scope)
    return "" if refusal is None else refusal.reason


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
        ({"cookie": f"omnid_1={LOCAL.new_cookie(Role.ALL)}"}, "no token"),
        ({"cookie": ";;=;"}, "no token"),
    ],
)
def test_the_token_or_its_cookie_is_needed(headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, headers) == expected
    assert reason(LOCAL, headers, OWN, kind="websocket", path="/live") == expected


@pytest.mark.parametrize("kind", ["http", "websocket"])
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
def test_commands_and_websockets_come_from_the_own_page(kind: str, headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, COOKIE, headers, kind=kind, method="POST", path="/stop") == expected


@pytest.mark.parametrize(
    ("path", "mode", "expected"),
    [
        ("/", "navigate", ""),
        ("/", "cors", "cross-site"),
        ("/metrics", "navigate", "cross-site"),
        ("/metrics", "no-cors", "cross-site"),
        ("/static/page.js", "no-cors", "cross-site"),
    ],
)
def test_other_sites_may_only_link_to_the_page(path: str, mode: str, expected: str) -> None:
    assert reason(LOCAL, COOKIE, {"sec-fetch-site": "cross-site", "sec-fetch-mode": mode}, path=path) == expected


def test_a_header_that_comes_twice_is_not_accepted() -> None:
    scope = {
        "type": "http",
        "path": "/metrics",
        "method": "GET",
        "headers": [(b"host", HOST.encode()), (b"host", b"evil.example"), (b"authorization", b"Bearer x")],
    }
    refusal = LOCAL.refusal(scope)
    assert refusal is not None and refusal.reason == "unknown host"


def test_only_the_page_that_asks_for_the_token_needs_none() -> None:
    assert [reason(LOCAL, path=path) for path in ("/", "/static/login.css")] == ["", ""]
    assert reason(LOCAL, OWN, path="/login", method="POST") == ""
    assert reason(LOCAL, OWN, path="/", kind="websocket") == "no token"
    assert reason(LOCAL, path="/static/page.js") == "no token"


def test_tokens_differ_and_the_file_keeps_one(tmp_path: Path) -> None:
    assert len({new_token() for _ in range(100)}) == 100 and len(new_token()) == 23
    path = tmp_path / "token"
    token = token_of(path)
    assert path.stat().st_mode & 0o777 == 0o600 and token_of(path) == token != token_of(None)


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (f"{TOKEN}\n", 0o644, "chmod 600"),
        ("short\n", 0o600, "16 to 256"),
        ("", 0o600, "16 to 256"),
        ("a" * 300, 0o600, "16 to 256"),
        ("has a space in it here\n", 0o600, "16 to 256"),
    ],
)
def test_unfit_token_files_are_refused(tmp_path: Path, text: str, mode: int, message: str) -> None:
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(OmnidError, match=message):
        token_of(path)
    with pytest.raises(OmnidError, match="cannot be made"):
        token_of(tmp_path / "missing" / "token")


def scope(path: str, method: str, **headers: str) -> dict[str, Any]:
    lines = [(name.encode(), value.encode()) for name, value in {"host": HOST, **headers}.items()]
    return {"type": "http", "path": path, "method": method, "headers": lines}


def test_the_token_for_stops_may_see_and_stop_and_nothing_else() -> None:
    access = Access(TOKEN, LOCAL.hosts, False, "omnid_8447", "stop-stop-stop-stop")
    for headers in (
        {"authorization": "Bearer stop-stop-stop-stop"},
        {"cookie": f"omnid_8447={access.new_cookie(Role.STOP)}", **OWN},
    ):
        for path, method in (("/", "GET"), ("/metrics", "GET"), ("/stop", "POST"), ("/robot/ab/stop", "POST")):
            assert access.refusal(scope(path, method, **headers)) is None
        for path in ("/arm", "/route", "/navigation", "/map", "/robot/ab/arm", "/recordings/1/report"):
            refusal = access.refusal(scope(path, "POST", **headers))
            assert refusal is not None and refusal.reason == "stop only"
    forged = access.new_cookie(Role.STOP).replace(".stop.", ".all.")
    assert access.refusal(scope("/arm", "POST", cookie=f"omnid_8447={forged}", **OWN)) is not None
    assert LOCAL.role_of("") is None, "without a token for stops an empty one is none"


def test_a_session_ends_and_others_with_the_same_token_go_on() -> None:
    access = Access(TOKEN, LOCAL.hosts, False, "omnid_8447")
    mine, other = (scope("/metrics", "GET", cookie=f"omnid_8447={access.new_cookie(Role.ALL)}") for _ in range(2))
    access.end_session(mine)
    assert access.refusal(mine) is not None and access.refusal(other) is None


def with_cookie(access: Access, role: Role, path: str = "/metrics", method: str = "GET") -> dict[str, Any]:
    return scope(path, method, cookie=f"{access.cookie}={access.new_cookie(role)}", **OWN)


def test_a_cookie_is_valid_for_30_days(monkeypatch: pytest.MonkeyPatch) -> None:
    request, now_s = with_cookie(LOCAL, Role.ALL), time.time()
    for later_s, enters in ((30 * 86_400 - 60, True), (30 * 86_400 + 60, False)):
        monkeypatch.setattr("omnid.web.access.time.time", lambda later_s=later_s: now_s + later_s)
        assert (LOCAL.refusal(request) is None) == enters
    assert COOKIE_S == 30 * 86_400


def test_a_cookie_of_another_server_or_for_stops_without_a_token_for_stops_is_none() -> None:
    other = Access("other-other-other-other", LOCAL.hosts, False, LOCAL.cookie)
    assert LOCAL.refusal(with_cookie(other, Role.ALL)) is not None
    assert LOCAL.refusal(with_cookie(LOCAL, Role.STOP)) is not None, "its key would be empty"
    assert LOCAL.has_token(with_cookie(LOCAL, Role.ALL)) and not LOCAL.has_token(with_cookie(other, Role.ALL))


def test_of_two_cookies_the_one_that_allows_more_counts() -> None:
    access = Access(TOKEN, LOCAL.hosts, False, "omnid_8447", "stop-stop-stop-stop")
    both = [f"omnid_8447={access.new_cookie(role)}" for role in (Role.STOP, Role.ALL)]
    for cookies in (both, both[::-1]):
        assert access.refusal(scope("/arm", "POST", cookie="; ".join(cookies), **OWN)) is None
    assert access.role_of(f" {TOKEN}\n") is Role.ALL and access.role_of("stop-stop-stop-stop") is Role.STOP


def test_only_so_many_ended_sessions_are_remembered_and_the_newest_of_them() -> None:
    access = Access(TOKEN, LOCAL.hosts, False, "omnid_8447")
    requests = [with_cookie(access, Role.ALL) for _ in range(MOST_ENDED + 1)]
    for request in requests:
        access.end_session(request)
    assert access.refusal(requests[0]) is None and access.refusal(requests[1]) is not None
    assert access.refusal(requests[-1]) is not None
    count = len(access._ended)
    access.end_session(scope("/logout", "POST", cookie="omnid_8447=nonsense; other=1", **OWN))
    other = access.new_cookie(Role.ALL)
    access.end_session(scope("/logout", "POST", cookie=f"omnid_1={other}", **OWN))
    assert other.partition(".")[0] not in access._ended, "that of another port"
    assert len(access._ended) == count == MOST_ENDED


@pytest.mark.parametrize(("mode", "enters"), [(0o640, True), (0o604, False), (0o602, False), (0o601, False)])
def test_a_token_file_is_for_its_owner_and_group(tmp_path: Path, mode: int, enters: bool) -> None:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(mode)
    if enters:
        assert token_of(path) == TOKEN
    else:
        with pytest.raises(OmnidError, match="chmod 600"):
            token_of(path)


def test_a_token_has_groups_of_letters_that_are_not_mistaken_for_others() -> None:
    groups = new_token().split("-")
    assert [len(group) for group in groups] == [5, 5, 5, 5]
    assert not set("".join(groups)) & set("01loi")
