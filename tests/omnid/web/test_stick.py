"""Requests of the stick: which texts are one, and which are refused, each for its reason."""

from __future__ import annotations

import asyncio
import time
from contextlib import closing

import pytest
from starlette.requests import Request

from omnid.client import Robot
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.errors import OmnidError
from omnid.monitor.robot_state import ReceivedMessage
from omnid.transport.bus import Bus
from omnid.transport.bus_config import BusConfig
from omnid.transport.pose_attachment import PoseAttachment
from omnid.web import snapshot
from omnid.web.feed import RobotFeed
from omnid.web.stick import StickCommands, StickRequest, stick_request
from omnid.web.wheel_commands import WheelCommands
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.waiting import wait_until

NOW_MS = 50_000


@pytest.fixture
def at_50_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server's time stand."""
    monkeypatch.setattr(snapshot, "server_ms", lambda: NOW_MS)


@pytest.fixture
def stick() -> StickCommands:
    feed = RobotFeed(BusConfig())
    return StickCommands(feed, WheelCommands(feed))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 -0.25 7 a1", StickRequest(1.0, -0.25, 7, "a1")),
        ("-1 1 123456789012345 z9", StickRequest(-1.0, 1.0, 123456789012345, "z9")),
        ("0.1234 -0.0 0 0", StickRequest(0.1234, 0.0, 0, "0")),
    ],
)
def test_a_request_of_the_stick(text: str, expected: StickRequest) -> None:
    assert stick_request(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "1.0001 0 1 a",
        "0 -1.0001 1 a",
        "-1.5 0 1 a",
        "2 0 1 a",
        "0.12345 0 1 a",
        "1 0 1 A",
        "1 0 1",
        "1 0 -1 a",
        " 1 0 1 a",
    ],
)
def test_other_texts_are_no_request_of_the_stick(text: str) -> None:
    with pytest.raises(OmnidError, match="the stick"):
        stick_request(text)


@pytest.mark.parametrize(("forward", "turn", "moves"), [(0.0, 0.0, False), (0.1, 0.0, True), (0.0, -0.1, True)])
def test_a_request_moves_that_asks_for_a_speed_or_a_turn(forward: float, turn: float, moves: bool) -> None:
    assert StickRequest(forward, turn, 0, "a").moves == moves


@pytest.mark.parametrize(
    ("age_ms", "recent"), [(0, True), (900, True), (1000, True), (1001, False), (60_000, False), (-1, False)]
)
def test_a_state_is_recent_for_one_second_and_none_comes_from_the_future(
    at_50_s: None, age_ms: int, recent: bool
) -> None:
    assert snapshot.is_recent(NOW_MS - age_ms) == recent


def test_a_late_request_moves_nothing_and_a_late_release_counts(at_50_s: None, stick: StickCommands) -> None:
    late_ms = NOW_MS - 1001
    assert "too slow" in stick._refusal(StickRequest(0.5, 0.0, late_ms, "a"))
    assert "too slow" in stick._refusal(StickRequest(0.0, 0.5, late_ms, "a"))
    assert stick._refusal(StickRequest(0.0, 0.0, late_ms, "a")) == ""
    assert stick._refusal(StickRequest(0.5, 0.0, NOW_MS, "a")) == ""


def test_one_page_drives_until_it_has_asked_for_nothing_for_a_while(at_50_s: None, stick: StickCommands) -> None:
    mine, other = StickRequest(0.5, 0.0, NOW_MS, "a"), StickRequest(0.5, 0.0, NOW_MS, "b")
    stick._page, stick._held_until_s = "a", time.monotonic() + 1000.0
    assert stick._refusal(other) == "another page drives" and stick._refusal(mine) == ""
    stick._held_until_s = time.monotonic() - 1e-6
    assert stick._refusal(other) == ""


def test_the_limits_are_read_again_after_the_robot_has_started_again() -> None:
    """By its token and, where the token was not seen to go, by the numbers of its poses."""

    def config(velocity_mps: float) -> str:
        return f"[controller.limits]\nvelocity_mps = {velocity_mps}\nyaw_rate_radps = 2.0\n"

    def read(stick: StickCommands) -> float:
        return asyncio.run(stick._limits_of_robot()).velocity_mps

    feed, endpoint = RobotFeed(BusConfig()), free_endpoint()
    stick = StickCommands(feed, WheelCommands(feed))
    assert read(stick) == VelocityLimits().velocity_mps
    with closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as feed.robot:
        bus.serve("config", config(1.5))
        wait_until(lambda: read(stick) == 1.5)
        bus.serve("config", config(0.3))
        assert read(stick) == 1.5, "a request of the stick does not wait for the robot's answer"
        feed.state.set_alive(False)
        feed.state.set_alive(True)
        assert read(stick) == 0.3
        bus.serve("config", config(0.7))
        for seq in (9, 0):
            feed.state.process(ReceivedMessage(1, "odom", odometry(seq), PoseAttachment(seq).to_bytes()))
        assert read(stick) == 0.7


def test_no_command_is_sent_before_the_last_one_has_ended(at_50_s: None, stick: StickCommands) -> None:
    stick._sending = True
    assert "overloaded" in stick._refusal(StickRequest(0.5, 0.0, NOW_MS, "a"))


@pytest.mark.parametrize(
    ("text", "is_sending", "words"),
    [
        ("2 0 1 a", False, "the stick"),
        (f"0.5 0 {NOW_MS - 1001} a", False, "too slow"),
        (f"0.5 0 {NOW_MS} a", True, "overloaded"),
        (f"0.5 0 {NOW_MS} a", False, "There is no connection: not connected yet"),
        (f"0 0 {NOW_MS - 1001} a", False, "There is no connection: not connected yet"),
    ],
)
def test_an_answer_to_what_is_not_sent_says_why(
    at_50_s: None, stick: StickCommands, text: str, is_sending: bool, words: str
) -> None:
    async def receive() -> dict[str, object]:
        return {"type": "http.request", "body": text.encode(), "more_body": False}

    stick._sending = is_sending
    asked = Request({"type": "http", "method": "POST", "path": "/drive", "headers": []}, receive)
    answer = asyncio.run(stick.drive(asked))
    assert not answer.done and words in answer.text
    assert stick._page == "" and stick._sending == is_sending, "no page drives"
