"""The outermost layer of the server without a server: what passes, what is refused, and with which headers."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from omnid.web.access import Access, Role
from omnid.web.guard import POLICY, Guard, Message, Receive, Scope, Send

HOST = "127.0.0.1:8447"
ACCESS = Access("abcde-fghjk-mnpqr-stuvw", frozenset(("127.0.0.1",)), False, "omnid_8447")
CLIENT = ("10.0.0.7", 4711)
COOKIE = f"omnid_8447={ACCESS.new_cookie(Role.ALL)}"
PROTECTION = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-store",
    b"content-security-policy": POLICY.encode(),
}


class Application:
    """An application that answers everything; it counts what reaches it."""

    def __init__(self, headers: list[tuple[bytes, bytes]]) -> None:
        self.headers, self.reached = headers, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.reached += 1
        await send({"type": "http.response.start", "status": 200, "headers": self.headers})
        await send({"type": "http.response.body", "body": b"well"})


def asked(
    kind: str = "http",
    *,
    path: str = "/metrics",
    method: str = "GET",
    answered: tuple[tuple[bytes, bytes], ...] = (),
    **headers: str,
) -> tuple[list[Message], Guard, Application, list[str]]:
    """Return what is sent for a request, the guard, the application, and what happened in its order."""
    application, sent, order = Application(list(answered)), [], []  # type: ignore[var-annotated]
    guard = Guard(application, ACCESS)
    guard.places.admit(CLIENT)
    lines = [(name.replace("_", "-").encode(), value.encode()) for name, value in {"host": HOST, **headers}.items()]
    scope = {"type": kind, "path": path, "method": method, "headers": lines, "client": CLIENT}

    async def receive() -> dict[str, Any]:
        order.append("received")
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        order.append(message["type"])
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    return sent, guard, application, order


def test_a_request_with_the_token_passes_and_its_answer_is_protected() -> None:
    sent, guard, application, _ = asked(cookie=COOKIE)
    assert application.reached == 1 and not guard.refused and sent[0]["status"] == 200
    assert dict(sent[0]["headers"]) == PROTECTION and sent[1]["body"] == b"well"


def test_headers_of_the_application_come_before_those_of_the_guard() -> None:
    own = (b"content-security-policy", b"default-src 'none'")
    sent, *_ = asked(cookie=COOKIE, answered=(own, (b"x-more", b"1")))
    assert dict(sent[0]["headers"]) == {**PROTECTION, b"x-more": b"1", own[0]: own[1]}
    assert len(sent[0]["headers"]) == len(PROTECTION) + 1, "each of them once"


@pytest.mark.parametrize(
    ("headers", "status", "reason", "words"),
    [
        ({}, 401, "no token", b"a token is needed"),
        ({"authorization": "Bearer wrong"}, 401, "wrong token", b"not that of this server"),
        ({"host": "evil.example"}, 403, "unknown host", b"not known by that name"),
        ({"cookie": COOKIE, "origin": "http://evil.example"}, 403, "cross-site", b"other sites"),
    ],
)
def test_other_requests_are_answered_by_the_guard_alone(
    headers: dict[str, str], status: int, reason: str, words: bytes
) -> None:
    sent, guard, application, _ = asked(**headers)
    assert application.reached == 0 and guard.refused == {reason: 1}
    start, body = sent
    assert start["status"] == status and words in body["body"] and body["body"].endswith(b"\n")
    found = dict(start["headers"])
    assert found[b"content-length"] == str(len(body["body"])).encode() and found[b"connection"] == b"close"
    assert {name: found[name] for name in PROTECTION} == PROTECTION


def test_a_websocket_is_closed_after_its_first_message_where_it_may_not_enter() -> None:
    sent, guard, application, order = asked("websocket", path="/live", cookie=COOKIE, origin="http://evil.example")
    assert application.reached == 0 and guard.refused == {"cross-site": 1}
    assert sent == [{"type": "websocket.close", "code": 1008, "reason": "cross-site"}]
    assert order == ["received", "websocket.close"]
    sent, _, application, _ = asked("websocket", path="/live", cookie=COOKIE, origin=f"http://{HOST}")
    assert application.reached == 1 and sent[0]["headers"] == [], "as the application has sent it"


def test_the_start_and_the_end_of_the_server_pass() -> None:
    _, guard, application, _ = asked("lifespan")
    assert application.reached == 1 and not guard.refused


def test_a_connection_that_has_shown_the_token_keeps_its_place() -> None:
    for headers, is_known in (({"cookie": COOKIE}, True), ({}, False), ({"authorization": "Bearer wrong"}, False)):
        _, guard, application, _ = asked(path="/", **headers)
        assert application.reached == 1 and guard.places._places[CLIENT].is_known == is_known
