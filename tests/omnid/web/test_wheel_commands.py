"""Stops, the stick and requests of a page, with a robot on the bus of the same process."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from omnid.client import Robot
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.monitor.stopping import stop
from omnid.monitor.teleop import FIRST_SHARE, limits_of
from omnid.transport import codec, driver
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.requests import Answer, Request
from omnid.transport.topics import command_topics
from omnid.web import snapshot, stick, wheel_commands
from omnid.web.feed import RobotFeed
from omnid.web.robot_page import RobotPage
from omnid.web.robot_requests import RobotRequests
from omnid.web.stick import StickCommands
from omnid.web.wheel_commands import WheelCommands, within
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.omnid.web.test_robot_requests import asked
from tests.waiting import wait_until

NOW_MS = 50_000


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
def connected(rover: Rover) -> Iterator[RobotFeed]:
    feed = rover.feed()
    with Robot(settings=feed.bus, timeout_s=30.0) as robot:
        feed.robot, feed.link = robot, ""
        wait_until(lambda: robot.driver().connected)
        yield feed


@pytest.fixture
def clock_ms(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The server's time, which stands until a test changes it."""
    now_ms = [NOW_MS]
    for module in (snapshot, wheel_commands):
        monkeypatch.setattr(module, "server_ms", lambda: now_ms[0])
    return now_ms


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

    monkeypatch.setattr(wheel_commands, "stop", counted)
    wheels = WheelCommands(rover.feed())

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


def test_a_stop_that_is_not_confirmed_says_so(rover: Rover, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wheel_commands, "stop", partial(stop, answer_s=0.1))
    assert asyncio.run(WheelCommands(rover.feed()).stop()) == Answer(
        False, "the stop is NOT confirmed: use the emergency stop"
    )
    monkeypatch.setattr(driver, "CONNECT_S", 0.01)
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))):  # a robot without wheels
        feed = RobotFeed(BusConfig(connect=(endpoint,)))
        with Robot(settings=feed.bus, timeout_s=30.0) as feed.robot:
            wheels = WheelCommands(feed)
            answer = asyncio.run(wheels.stop())
            assert not answer.done and not wheels.is_stopping
            assert "NOT confirmed: use the emergency stop. no robot 'omnid' receives" in answer.text


def test_a_driver_is_there_with_the_connection_and_without_one_the_reason(connected: RobotFeed) -> None:
    wheels, robot = WheelCommands(connected), connected.robot
    connected.robot, connected.link = None, "no route"
    assert wheels.ready_driver() is None and wheels.why_not() == "There is no connection: no route"
    connected.robot, connected.link = robot, ""
    assert wheels.why_not().startswith("No robot of that name")
    driver = wheels.ready_driver()
    assert driver is not None and wheels.ready_driver() is driver
    wait_until(lambda: driver.connected)
    assert wheels.why_not().startswith("Either this program must not command it")
    connected.bus = BusConfig(robot="other", connect=connected.bus.connect)
    with Robot(settings=connected.bus, timeout_s=30.0) as connected.robot:
        stranger = WheelCommands(connected)
        assert stranger.ready_driver() is not None and stranger.why_not().startswith("No robot of that name")


def test_a_robot_that_does_not_read_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    reads = threading.Event()
    wheels = WheelCommands(RobotFeed(BusConfig()))
    wait, timeouts_s = asyncio.wait, list[float | None]()

    async def recorded(calls: list[asyncio.Future[Any]], timeout: float | None = None) -> Any:
        timeouts_s.append(timeout)
        return await wait(calls, timeout=timeout)

    with monkeypatch.context() as patched:
        patched.setattr(asyncio, "wait", recorded)
        assert asyncio.run(within(wheels._thread, lambda: 7)) == 7
    assert timeouts_s == [driver.ANSWER_S / 2]
    monkeypatch.setattr(wheel_commands, "ANSWER_S", 0.01)

    async def blocked() -> object:
        found = await within(wheels._thread, lambda: reads.wait(30.0))
        reads.set()
        return found

    assert asyncio.run(blocked()) is None


def test_the_stick_sends_a_share_of_the_limits(
    rover: Rover, connected: RobotFeed, clock_ms: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = StickCommands(connected, WheelCommands(connected))
    reads, takes_ms, limits = list[bool](), [0], VelocityLimits(velocity_mps=0.7, yaw_rate_radps=1.5)
    mps, radps = FIRST_SHARE * limits.velocity_mps, FIRST_SHARE * limits.yaw_rate_radps

    def slow_limits_of(robot: Robot) -> VelocityLimits:
        reads.append(commands._sending)
        clock_ms[0] += takes_ms[0]
        return limits_of(robot)

    monkeypatch.setattr(stick, "limits_of", slow_limits_of)

    def answer(forward: float, turn: float, page: str = "a", late_ms: int = 0) -> Answer:
        return asyncio.run(commands.drive(asked(f"{forward:g} {turn:g} {clock_ms[0] - late_ms} {page}")))

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
        before_s = time.monotonic()
        assert answer(forward, turn) == Answer(True, words)
        assert before_s + stick.HELD_S <= commands._held_until_s <= time.monotonic() + stick.HELD_S
        wait_until(partial(rover.has_more_than, count))
        assert rover.twists[count:] == [pytest.approx((forward * mps, turn * radps))]
        assert not commands._sending
    assert len(reads) == 1, "the limits are read once"
    assert answer(1, 0, "b") == Answer(False, "another page drives")
    # 3. A release counts, however late.
    count = len(rover.twists)
    assert answer(0, 0, late_ms=5000) == Answer(True, "the stick is released: it stands")
    wait_until(lambda: len(rover.twists) > count)
    assert rover.twists[count:] == [(0.0, 0.0)]


def test_a_late_release_as_the_first_request_is_sent(rover: Rover, connected: RobotFeed, clock_ms: list[int]) -> None:
    commands = StickCommands(connected, WheelCommands(connected))
    assert asyncio.run(commands.drive(asked(f"0 0 {clock_ms[0] - 5000} a"))).done
    wait_until(lambda: rover.twists == [(0.0, 0.0)])


def test_nothing_drives_or_arms_while_a_stop_is_not_confirmed(
    rover: Rover, connected: RobotFeed, clock_ms: list[int]
) -> None:
    page = RobotPage(connected)

    async def refused() -> tuple[Answer, Answer]:
        stopping = asyncio.create_task(page.wheels.stop())
        await until(lambda: "cmd/stop" in rover.topics)
        answers = await page._stick.drive(asked(f"1 0 {clock_ms[0]} a")), await page._arm(asked(str(clock_ms[0])))
        rover.is_stopped = True
        assert (await stopping).done
        return answers

    drive, arm = asyncio.run(refused())
    assert drive == Answer(False, "a stop is not confirmed yet: drive after it")
    assert arm == Answer(False, "a stop is not confirmed yet: arm after it")
    assert set(rover.topics) == {"cmd/stop"}
    assert asyncio.run(page._arm(asked(str(clock_ms[0])))).done
    assert rover.topics[-1] == "cmd/arm"


@pytest.mark.hazard("H47")
def test_arming_that_was_asked_for_before_a_stop_and_comes_after_it_is_refused(
    rover: Rover, connected: RobotFeed, clock_ms: list[int]
) -> None:
    page, before_ms = RobotPage(connected), clock_ms[0]
    rover.is_stopped = True
    clock_ms[0] += 200
    assert asyncio.run(page.wheels.stop()).done
    clock_ms[0] += 200
    assert asyncio.run(page._arm(asked(str(before_ms)))).text.startswith("a stop was asked for since")
    assert "cmd/arm" not in rover.topics
    assert asyncio.run(page._arm(asked(str(clock_ms[0])))).done


def test_requests_are_answered_by_the_robot_one_of_each_kind_at_a_time(
    rover: Rover, connected: RobotFeed, clock_ms: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    requests = RobotRequests(connected)

    async def crowd() -> list[Answer]:
        rover.answering.clear()
        first = asyncio.create_task(requests.goal(asked(f"1 2 {clock_ms[0]}")))
        await until(lambda: "cmd/goal" in rover.topics)
        second = await requests.goal(asked(f"3 4 {clock_ms[0]}"))
        arm = asyncio.create_task(requests.arm(asked(str(clock_ms[0]))))  # of another kind
        await until(lambda: requests._busy == {"goal", "arm"})
        rover.answering.set()
        return [second, *await asyncio.gather(first, arm), await requests.goal(asked(f"5 6 {clock_ms[0]}"))]

    granted = Answer(True, "as asked")
    assert asyncio.run(crowd()) == [Answer(False, "another request has no answer yet"), granted, granted, granted]
    assert rover.topics == ["cmd/goal", "cmd/arm", "cmd/goal"] and requests.arms == 1
    rover.is_granted = False
    assert asyncio.run(requests.save_map()) == Answer(False, "omnid refuses: a fault holds")
    assert asyncio.run(requests.navigation(asked("pause"))) == Answer(False, "omnid refuses: a fault holds")
    monkeypatch.setattr(driver, "CONNECT_S", 0.01)
    with Robot("other", settings=BusConfig(robot="other", connect=(rover.endpoint,)), timeout_s=30.0) as other:
        connected.robot = other
        for _ in range(2):  # the first does not keep the second out
            answer = asyncio.run(requests.arm(asked(str(clock_ms[0]))))
            assert not answer.done and "takes such requests" in answer.text
