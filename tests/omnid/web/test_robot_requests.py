"""Requests of the page to the robot, before they are passed on: goals, and how much of a body is read."""

from __future__ import annotations

import asyncio
import math

import pytest
from starlette.requests import Request

from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.web import robot_requests, snapshot
from omnid.web.feed import RobotFeed
from omnid.web.robot_requests import LONGEST_BODY, RobotRequests, goal_of, text_of

NOW_MS = 50_000


@pytest.fixture
def at_50_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server's time stand."""
    monkeypatch.setattr(snapshot, "server_ms", lambda: NOW_MS)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"1.5 -2 {NOW_MS}", (1.5, -2.0, None)),
        (f"-0.25 3.1234 -90 {NOW_MS - 1000}", (-0.25, 3.1234, -math.pi / 2)),
        (f"0 0 0 {NOW_MS}", (0.0, 0.0, 0.0)),
    ],
)
def test_a_goal_is_in_metres_and_degrees(at_50_s: None, text: str, expected: tuple[float, float, float | None]) -> None:
    assert goal_of(text) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"1 2 {NOW_MS - 1001}", "too late"),
        (f"1 2 30 {NOW_MS + 1}", "too late"),
        (f"1 {NOW_MS}", "X Y STAMP"),
        (f"1 2 3 4 {NOW_MS}", "X Y STAMP"),
        (f"1000000.5 2 {NOW_MS * 10**9}00", "X Y STAMP"),
    ],
)
def test_other_goals_are_refused(at_50_s: None, text: str, words: str) -> None:
    with pytest.raises(OmnidError, match=words):
        goal_of(text)


def body(*chunks: bytes, ends: bool = True) -> str:
    """Return the text of a request whose body comes in chunks."""
    messages = [
        {"type": "http.request", "body": chunk, "more_body": not ends or k < len(chunks) - 1}
        for k, chunk in enumerate(chunks)
    ]

    async def receive() -> dict[str, object]:
        if not messages:
            await asyncio.Event().wait()
        return messages.pop(0)

    return asyncio.run(text_of(Request({"type": "http", "method": "POST", "path": "/", "headers": []}, receive)))


def test_a_body_is_read_to_its_end_and_no_farther_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    assert body(b"teach ", b"hall") == "teach hall"
    assert body(b"x" * LONGEST_BODY) == "x" * LONGEST_BODY
    for chunks in ([b"x" * (LONGEST_BODY + 1)], [b"x" * LONGEST_BODY, b"x", b"x"]):
        with pytest.raises(OmnidError, match="256 bytes"):
            body(*chunks)
    monkeypatch.setattr(robot_requests, "BODY_S", 0.005)
    with pytest.raises(OmnidError, match="did not come"):
        body(b"teach ", ends=False)


def asked(text: str) -> Request:
    """Return a request with a text."""

    async def receive() -> dict[str, object]:
        return {"type": "http.request", "body": text.encode(), "more_body": False}

    return Request({"type": "http", "method": "POST", "path": "/", "headers": []}, receive)


def test_what_is_no_request_and_what_finds_no_robot_is_not_done(at_50_s: None) -> None:
    requests = RobotRequests(RobotFeed(BusConfig()))
    for ask, text, words in (
        (requests.goal, "1 2", "X Y STAMP"),
        (requests.route, "teach", "no request about routes"),
        (requests.navigation, "stop", "no request to the navigation"),
        (requests.goal, f"1 2 {NOW_MS}", "There is no connection: not connected yet"),
        (requests.route, "teach hall", "There is no connection"),
        (requests.navigation, "pause", "There is no connection"),
    ):
        answer = asyncio.run(ask(asked(text)))
        assert not answer.done and words in answer.text
    assert requests.arms == 0
    assert not asyncio.run(requests.arm(asked(str(NOW_MS)))).done and requests.arms == 1


@pytest.mark.hazard("H47")
def test_what_lets_the_robot_move_and_comes_late_or_without_a_stamp_is_refused(at_50_s: None) -> None:
    requests = RobotRequests(RobotFeed(BusConfig()))
    late = NOW_MS - 1001
    for ask, text, words in (
        (requests.arm, "", "server_ms"),
        (requests.arm, f"{late}", "too late"),
        (requests.arm, f"{NOW_MS + 1}", "too late"),
        (requests.arm, f"{NOW_MS} x", "server_ms"),
        (requests.route, "repeat hall", "server_ms"),
        (requests.route, f"repeat hall {NOW_MS}", "expected"),
        (requests.route, f"repeat hall loops=2 stamp={late}", "too late"),
        (requests.route, f"repeat hall stamp={NOW_MS} loops=2", "expected"),
        (requests.navigation, "resume", "server_ms"),
        (requests.navigation, f"resume stamp={late}", "too late"),
        (requests.route, f"repeat hall loops=2 stamp={NOW_MS}", "There is no connection"),
        (requests.navigation, f"resume stamp={NOW_MS}", "There is no connection"),
        (requests.navigation, f"cancel stamp={late}", "There is no connection"),
        (requests.route, "stop", "There is no connection"),
    ):
        answer = asyncio.run(ask(asked(text)))
        assert not answer.done and words in answer.text, text
    assert requests.arms == 0
