"""Requests to the navigation from the bus: decoded strictly, bounded, counted, with the advice in one line."""

from __future__ import annotations

import math
import random
import time

import numpy as np
import pytest

from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
)
from omnid.errors import OmnidError
from omnid.transport.navigation_codec import (
    PlanarGoal,
    goal_cdr,
    goal_from_cdr,
    path_cdr,
    path_from_cdr,
    string_cdr,
    string_from_cdr,
)
from omnid.transport.navigation_commands import LONGEST_PAYLOAD, MOST_WAITING, NavigationReceiver, RequestQueue
from omnid.transport.requests import Answer, Request
from omnid.transport.stamps import StampRule

MAP = NavigationFrame.MAP


class Received:
    """A receiver and what came of it."""

    def __init__(self, *, synchronised: bool = True) -> None:
        self.commands: list[NavigationCommand] = []
        self.lines: list[str] = []
        self.answer: Answer | None = None  # of the newest message
        self.stamps = StampRule(0.5, synchronised=synchronised)
        self.receiver = NavigationReceiver(self.commands.append, self.stamps, report=self.lines.append)

    def send(self, topic: str, payload: bytes, sent_ns: int = 0) -> NavigationCommand | None:
        """Return the command that a message leads to."""
        before = len(self.commands)
        self.answer = self.receiver.receive(Request(f"cmd/{topic}", payload, "", sent_ns, 5))
        return self.commands[-1] if len(self.commands) > before else None


def goal(stamp_ns: int, x: float = 1.5, y: float = -2.0, heading: float | None = 0.5, frame: str = "map") -> bytes:
    return goal_cdr(PlanarGoal(stamp_ns, frame, x, y, heading))


def test_messages_round_trip() -> None:
    found = goal_from_cdr(goal(12_000_000_034))
    assert found[:4] == (12_000_000_034, "map", 1.5, -2.0) and found.heading_rad == pytest.approx(0.5)
    assert goal_from_cdr(goal(5, heading=None)).heading_rad is None
    xy = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 0.0]])
    path = path_from_cdr(path_cdr(7, "odom", xy, -1.0))
    assert path[:2] == (7, "odom") and path.heading_rad == pytest.approx(-1.0)
    np.testing.assert_array_equal(path.xy, xy)
    assert path_from_cdr(path_cdr(7, "odom", xy)).heading_rad is None
    assert string_from_cdr(string_cdr("repeat hall")) == "repeat hall"


def test_requests_are_passed_on() -> None:
    received, now_ns = Received(), time.time_ns()
    command = received.send("goal", goal(now_ns))
    assert command is not None and (command.stamp_ns, command.id) == (now_ns, 5) and received.answer is None
    assert command.request == GoalRequest(MAP, 1.5, -2.0, pytest.approx(0.5))
    command = received.send("path", path_cdr(now_ns, "odom", [[0, 0], [1, 1]]))
    assert command is not None and isinstance(command.request, PathRequest)
    verbs = [received.send("navigation", string_cdr(verb), time.time_ns()).request for verb in NavigationVerb]
    assert verbs == list(NavigationVerb)
    assert received.send("route", string_cdr("repeat hall loops=2"), time.time_ns()).request == RouteRequest(
        RouteAction.REPEAT, "hall", False, 2
    )
    assert not received.lines and received.receiver.accepted == 6


@pytest.mark.hazard("H27")
@pytest.mark.parametrize("age_s", [-2.0, 2.0, 3600.0])
def test_a_goal_of_another_time_is_refused_and_a_halt_is_not(age_s: float) -> None:
    received, sent_ns = Received(), time.time_ns() - round(age_s * 1e9)
    assert received.send("goal", goal(sent_ns)) is None
    assert received.send("goal", goal(0)) is None, "it has no stamp"
    assert received.send("route", string_cdr("repeat hall"), sent_ns) is None
    assert received.send("navigation", string_cdr("resume"), sent_ns) is None
    for topic, text in (("navigation", "cancel"), ("navigation", "pause"), ("route", "stop")):
        assert received.send(topic, string_cdr(text), sent_ns) is not None
    assert received.receiver.refused == {"cmd/goal": 2, "cmd/route": 1, "cmd/navigation": 1}
    assert all("bus.command_clock" in line and "\n" not in line for line in received.lines)
    assert Received(synchronised=False).send("goal", goal(sent_ns)) is not None


@pytest.mark.hazard("H27")
@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize(
    ("topic", "text"), [("route", "repeat hall"), ("route", "teach hall"), ("navigation", "resume")]
)
def test_what_begins_a_motion_needs_a_stamp_and_what_ends_one_does_not(
    topic: str, text: str, synchronised: bool
) -> None:
    received, now_ns = Received(synchronised=synchronised), time.time_ns()
    assert received.send(topic, string_cdr(text)) is None and "no stamp" in received.lines[0]
    assert received.send(topic, string_cdr(f"{text} stamp=0")) is None
    command = received.send(topic, string_cdr(f"{text} stamp={now_ns}"))
    assert command is not None and command.stamp_ns == now_ns
    assert received.send(topic, string_cdr(text), now_ns + 10) is not None
    for end_topic, end in (("navigation", "cancel"), ("navigation", "pause"), ("route", "stop"), ("route", "finish")):
        assert received.send(end_topic, string_cdr(end)) is not None


@pytest.mark.hazard("H27")
def test_requests_of_another_clock_that_are_recorded_and_sent_again_are_refused() -> None:
    """A request to arm lets the stamps begin again, as of another sender."""
    received, recorded = Received(synchronised=False), string_cdr("repeat hall stamp=1000")
    assert received.send("route", recorded) is not None
    assert received.send("route", recorded) is None and "does not rise" in received.lines[0]
    assert received.send("goal", goal(1000)) is not None and received.send("goal", goal(1000)) is None
    received.stamps.accept_arm(5)
    assert received.send("route", recorded) is not None


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        ("goal", goal_cdr(PlanarGoal(1, "map", math.nan, 0.0, 0.0))),
        ("goal", goal_cdr(PlanarGoal(1, "map", math.inf, 0.0, 0.0))),
        ("goal", goal_cdr(PlanarGoal(1, "map", 2e6, 0.0, 0.0))),
        ("goal", goal_cdr(PlanarGoal(1, "base_link", 1.0, 0.0, 0.0))),
        ("goal", goal_cdr(PlanarGoal(1, "", 1.0, 0.0, 0.0))),
        ("goal", b""),
        ("goal", b"\0" * 4097),
        ("path", b"\0" * (LONGEST_PAYLOAD + 1)),
        ("path", path_cdr(1, "map", np.zeros((10_001, 2)))),
        ("path", path_cdr(1, "map", [[0.0, 0.0], [0.0, math.nan]])),
        ("navigation", string_cdr("dance")),
        ("route", string_cdr("teach ../../etc/passwd")),
        ("route", b"teach a"),
    ],
)
def test_what_is_no_request_is_refused(topic: str, payload: bytes) -> None:
    received = Received(synchronised=False)
    assert received.send(topic, payload) is None
    assert received.answer is not None and not received.answer.done and received.answer.text in received.lines[0]
    assert received.receiver.refused.total() == 1 and len(received.lines) == 1
    assert received.receiver.status().values[f"refused, cmd/{topic}"] == "1"


@pytest.mark.hazard("H33")
def test_damaged_messages_never_raise_and_lead_to_finite_goals() -> None:
    rng, received = random.Random(4), Received(synchronised=False)
    good = {
        "goal": goal(1),
        "path": path_cdr(1, "map", [[0, 0], [1, 0], [2, 1]]),
        "route": string_cdr("repeat a"),
        "navigation": string_cdr("cancel"),
    }
    for _ in range(2000):
        topic = rng.choice(list(good))
        damaged = bytearray(good[topic])
        for _ in range(rng.randint(1, 8)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        received.send(topic, bytes(damaged[: rng.randint(0, len(damaged))]) if rng.random() < 0.3 else bytes(damaged))
    for command in received.commands:
        if isinstance(command.request, GoalRequest):
            assert abs(command.request.x_m) <= 1e6 and abs(command.request.y_m) <= 1e6
    assert received.receiver.refused.total() + received.receiver.accepted == 2000


def test_a_tilted_goal_is_refused() -> None:
    payload = bytearray(goal(1, heading=0.0))
    payload[-32:-24] = np.float64(0.7071).tobytes()  # x of the quaternion
    payload[-8:] = np.float64(0.7071).tobytes()
    with pytest.raises(OmnidError, match="about z"):
        goal_from_cdr(bytes(payload))


def test_the_queue_gives_all_requests_even_where_a_batch_is_dropped() -> None:
    queue = RequestQueue()
    commands = [NavigationCommand(NavigationVerb.PAUSE, k) for k in range(3)]
    for command in commands:
        queue.put(command)
    batches = queue.batches()
    next(batches)  # dropped by an inbox
    assert list(next(batches)) == commands
    queue.end()
    assert list(next(batches)) == []
    assert list(batches) == []


def test_the_queue_keeps_the_newest_of_too_many() -> None:
    queue = RequestQueue()
    for k in range(MOST_WAITING + 5):
        queue.put(NavigationCommand(NavigationVerb.PAUSE, k))
    assert [command.arrival_ns for command in next(queue.batches())] == list(range(5, MOST_WAITING + 5))
