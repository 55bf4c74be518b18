"""Stops, the stick and requests of a page, with a robot on the bus of the same process and a clock that stands."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

import pytest

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from starlette.requests import Request as WebRequest
from starlette.routing import Route

from omnid.client import Robot
from omnid.core.control.heading_controller import VelocityLimits
from omnid.monitor.navigation import stop
from omnid.monitor.robot_state import ReceivedMessage
from omnid.monitor.teleop import FIRST_SHARE, limits_of
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import PoseAttachment
from omnid.transport.topics import Answer, Request, command_topics
from omnid.web import feed, robot
from omnid.web.feed import RobotFeed
from omnid.web.robot import RobotPage
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.waiting import wait_until

NOW_MS = 50_000
LATE_MS = NOW_MS - 1001


class Rover:
    """A robot that keeps what it is asked for, and confirms stops where it is told to."""

    def __init__(self, bus: Bus, endpoint: str) -> None:
        self._bus, self.endpoint = bus, endpoint
        self.topics, self.twists = list[str](), list[tuple[float, float]]()
        self.is_stopped, self.is_granted = False, True
        self.answering = threading.Event()
        self.answering.set()
        bus.serve("config", "[controller.limits]\nvelocity_mps = 0.7\nyaw_rate_radps = 1.5\n")
        bus.subscribe_commands(self._take, command_topics(("operator",)), lambda: self.is_stopped)

    def _take(self, request: Request) -> None:
        self.topics.append(request.topic)
        if request.topic == "cmd/twist":
            command = codec.twist_from_cdr(request.payload)
            self.twists.append((command.velocity_mps, command.yaw_rate_radps))
        elif request.topic != "cmd/stop":
            self.answering.wait(30.0)
            self._bus.answer(request.id, Answer(self.is_granted, "as asked" if self.is_granted else "a fault holds"))

    def has_more_than(self, count: int) -> bool:
        """True if it got more twists."""
        return len(self.twists) > count

    def feed(self) -> RobotFeed:
        """Return a feed that has no connection yet."""
        return RobotFeed(BusConfig(connect=(self.endpoint,)))


@pytest.fixture
def rover() -> Iterator[Rover]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        yield Rover(bus, endpoint)


@pytest.fixture
def page(rover: Rover) -> Iterator[RobotPage]:
    """A page that is connected to the robot."""
    feed = rover.feed()
    with Robot(settings=feed.bus, timeout_s=30.0) as connection:
        feed.robot, feed.link = connection, ""
        wait_until(lambda: connection.driver().connected)
        yield RobotPage(feed)


@pytest.fixture
def alone() -> RobotPage:
    """A page without a connection."""
    return RobotPage(RobotFeed(BusConfig()))


@pytest.fixture(autouse=True)
def clock_ms(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The server's time, which stands until a test changes it."""
    now_ms = [NOW_MS]
    for module in (feed, robot):
        monkeypatch.setattr(module, "server_ms", lambda: now_ms[0])
    return now_ms


async def posted(page: RobotPage, path: str, *chunks: str, ends: bool = True) -> Answer:
    """Return the answer to a request whose body comes in chunks."""
    messages = [
        {"type": "http.request", "body": chunk.encode(), "more_body": not ends or k < len(chunks) - 1}
        for k, chunk in enumerate(chunks or ("",))
    ]

    async def receive() -> dict[str, object]:
        if not messages:
            await asyncio.Event().wait()
        return messages.pop(0)

    route = next(route for route in page.routes() if isinstance(route, Route) and route.path == path)
    response = await route.endpoint(
        WebRequest({"type": "http", "method": "POST", "path": path, "headers": []}, receive)
    )
    answer = Answer(**json.loads(response.body))
    assert response.status_code == (200 if answer.done else 409)
    return answer


def post(page: RobotPage, path: str, *chunks: str, ends: bool = True) -> Answer:
    return asyncio.run(posted(page, path, *chunks, ends=ends))


async def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition without blocking the event loop."""
    await asyncio.to_thread(wait_until, condition, pause_s=0.002)


def test_a_stop_ends_once_it_is_confirmed_and_one_asked_for_meanwhile_is_sent_again(
    rover: Rover, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds = list[object]()

    def counted(bus: BusConfig, connection: Robot | None = None) -> bool:
        rounds.append(connection)
        return stop(bus, connection=connection)

    monkeypatch.setattr(robot, "stop", counted)
    wheels = RobotPage(rover.feed())

    async def stops() -> list[Answer]:
        assert not wheels.is_stopping and wheels.stops == 0
        first = asyncio.create_task(wheels.stop())
        await until(lambda: "cmd/stop" in rover.topics)
        assert wheels.is_stopping and not first.done()
        others = [asyncio.create_task(wheels.stop()) for _ in range(2)]
        gone = asyncio.create_task(wheels.stop())
        await asyncio.sleep(0)
        gone.cancel()  # a browser that goes
        rover.is_stopped = True
        answers = await asyncio.gather(first, *others)
        assert not wheels.is_stopping and wheels.stops == 4 and len(rounds) == 2, rounds
        answers.append(await wheels.stop())  # later, it is sent once more
        assert wheels.stops == 5 and len(rounds) == 3
        return answers

    expected = Answer(True, "the robot stops: its wheels stand until it is armed")
    assert asyncio.run(stops()) == [expected] * 4


def test_the_stick_sends_a_share_of_the_limits(
    rover: Rover, page: RobotPage, clock_ms: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, takes_ms, limits = list[bool](), [0], VelocityLimits(velocity_mps=0.7, yaw_rate_radps=1.5)
    mps, radps = FIRST_SHARE * limits.velocity_mps, FIRST_SHARE * limits.yaw_rate_radps

    def slow_limits_of(connection: Robot) -> VelocityLimits:
        reads.append(page._sending)
        clock_ms[0] += takes_ms[0]
        return limits_of(connection)

    monkeypatch.setattr(robot, "limits_of", slow_limits_of)

    def answer(forward: float, turn: float, name: str = "a", late_ms: int = 0) -> Answer:
        return post(page, "/drive", f"{forward:g} {turn:g} {clock_ms[0] - late_ms} {name}")

    # 1. The request for which the limits were read so long that it is late moves nothing; it is the page that drives.
    takes_ms[0] = 1001
    assert answer(1, 0) == Answer(False, "the stick is ready now") and not rover.twists
    assert reads == [True], "no other command is sent while it waits"
    # 2. Each further one is sent.
    for forward, turn, words in (
        (1.0, -0.5, f"it drives by the stick: {mps:+.2f} m/s, {-28.6479 * radps:+.0f}°/s"),
        (-0.25, 0.0, f"it drives by the stick: {-0.25 * mps:+.2f} m/s, +0°/s"),
        (0.0, 1.0, f"it drives by the stick: +0.00 m/s, {57.2958 * radps:+.0f}°/s"),
    ):
        count = len(rover.twists)
        assert answer(forward, turn) == Answer(True, words)
        wait_until(partial(rover.has_more_than, count))
        assert rover.twists[count:] == [pytest.approx((forward * mps, turn * radps))]
    assert len(reads) == 1, "the limits are read once"
    assert answer(1, 0, "b") == Answer(False, "another page drives")
    # 3. A release counts, however late; another page drives after a while without requests.
    count = len(rover.twists)
    assert answer(0, 0, late_ms=5000) == Answer(True, "the stick is released: it stands")
    wait_until(lambda: len(rover.twists) > count)
    assert rover.twists[count:] == [(0.0, 0.0)]
    page._held_until_s = 0.0
    assert answer(1, 0, "b").done


def test_the_limits_are_read_again_after_the_robot_has_started_again(alone: RobotPage) -> None:
    """By its token and, where the token was not seen to go, by the run in its poses."""
    feed, endpoint = alone.feed, free_endpoint()
    with closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as connection:

        def serve(velocity_mps: float) -> None:
            bus.serve("config", f"[controller.limits]\nvelocity_mps = {velocity_mps}\nyaw_rate_radps = 2.0\n")

        def read() -> float:
            return asyncio.run(alone._limits_of(connection)).velocity_mps

        serve(1.5)
        wait_until(lambda: connection.query("config") != "")
        assert read() == 1.5
        serve(0.3)
        assert read() == 1.5, "a request of the stick does not wait for the robot's answer"
        feed.state.set_alive(False)
        feed.state.set_alive(True)
        assert read() == 0.3
        serve(0.7)
        feed.state.process(ReceivedMessage(1, "odom", odometry(1), PoseAttachment(run="b").to_bytes(), 1))
        assert read() == 0.7


def test_nothing_drives_or_arms_while_a_stop_is_not_confirmed(rover: Rover, page: RobotPage) -> None:
    async def refused() -> tuple[Answer, Answer]:
        stopping = asyncio.create_task(page.stop())
        await until(lambda: "cmd/stop" in rover.topics)
        answers = await posted(page, "/drive", f"1 0 {NOW_MS} a"), await posted(page, "/arm", f"{NOW_MS}")
        rover.is_stopped = True
        assert (await stopping).done
        return answers

    drive, arm = asyncio.run(refused())
    assert drive == Answer(False, "a stop is not confirmed yet: drive after it")
    assert arm == Answer(False, "a stop is not confirmed yet: arm after it")
    assert set(rover.topics) == {"cmd/stop"}
    assert post(page, "/arm", f"{NOW_MS}").done and rover.topics[-1] == "cmd/arm"


@pytest.mark.hazard("H47")
def test_arming_that_was_asked_for_before_a_stop_and_comes_after_it_is_refused(
    rover: Rover, page: RobotPage, clock_ms: list[int]
) -> None:
    rover.is_stopped = True
    clock_ms[0] += 200
    assert asyncio.run(page.stop()).done
    clock_ms[0] += 200
    assert post(page, "/arm", f"{NOW_MS}").text.startswith("a stop was asked for since")
    assert "cmd/arm" not in rover.topics
    assert post(page, "/arm", f"{clock_ms[0]}").done


@pytest.mark.hazard("H47")
@pytest.mark.parametrize(
    ("path", "text", "words"),
    [
        ("/arm", "", "server_ms"),
        ("/arm", f"{LATE_MS}", "too late"),
        ("/arm", f"{NOW_MS + 1}", "too late"),
        ("/arm", f"{NOW_MS} x", "server_ms"),
        ("/route", "repeat hall", "server_ms"),
        ("/route", f"repeat hall {NOW_MS}", "expected"),
        ("/route", f"repeat hall loops=2 stamp={LATE_MS}", "too late"),
        ("/route", f"repeat hall stamp={NOW_MS} loops=2", "expected"),
        ("/route", "teach", "no request about routes"),
        ("/navigation", "resume", "server_ms"),
        ("/navigation", f"resume stamp={LATE_MS}", "too late"),
        ("/navigation", "stop", "no request to the navigation"),
        ("/goal", f"1 2 {LATE_MS}", "too late"),
        ("/goal", f"1 2 30 {NOW_MS + 1}", "too late"),
        ("/goal", f"1 {NOW_MS}", "X Y STAMP"),
        ("/goal", f"1 2 3 4 {NOW_MS}", "X Y STAMP"),
        ("/goal", f"1000000.5 2 {NOW_MS * 10**9}00", "X Y STAMP"),
        ("/drive", f"0.5 0 {LATE_MS} a", "too slow"),
        ("/drive", f"0 0.5 {NOW_MS + 1} a", "too slow"),
        *(("/drive", text, "the stick sends") for text in ("1.0001 0 1 a", "0 -1.5 1 a", "2 0 1 a", "0.12345 0 1 a")),
        *(("/drive", text, "the stick sends") for text in ("1 0 1 A", "1 0 1", "1 0 -1 a", " 1 0 1 a", "nan 0 1 a")),
    ],
)
def test_what_lets_the_robot_move_and_comes_late_or_without_a_stamp_is_refused(
    rover: Rover, page: RobotPage, path: str, text: str, words: str
) -> None:
    answer = post(page, path, text)
    assert not answer.done and words in answer.text and not rover.topics and page.arms == 0
