"""Stops, the stick and requests of a page, with a robot on the bus of the same process and a clock that stands."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PlanarPath, goal_from_cdr, string_from_cdr
from omnid.transport.status_names import NAVIGATION, WHEELS, Key
from omnid.transport.topics import Answer, Request, command_topics
from omnid.web.server import STATIC
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.omnid.web.servers import Shown, WebServer, served

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from starlette.requests import Request as WebRequest
from starlette.routing import Route

from omnid.client import Robot
from omnid.core.control.heading_controller import VelocityLimits
from omnid.monitor.navigation import stop
from omnid.monitor.teleop import FIRST_SHARE, limits_of
from omnid.web import feed, robot
from omnid.web.feed import RobotFeed
from omnid.web.robot import RobotPage
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
        assert not wheels.is_stopping
        first = asyncio.create_task(wheels.stop())
        await until(lambda: "cmd/stop" in rover.topics)
        assert wheels.is_stopping and not first.done()
        others = [asyncio.create_task(wheels.stop()) for _ in range(2)]
        gone = asyncio.create_task(wheels.stop())
        await asyncio.sleep(0)
        gone.cancel()  # a browser that goes
        rover.is_stopped = True
        answers = await asyncio.gather(first, *others)
        assert not wheels.is_stopping and len(rounds) == 2, rounds
        answers.append(await wheels.stop())  # later, it is sent once more
        assert len(rounds) == 3
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
    assert len(reads) == 1, "the limits are read once while a page holds the stick"
    assert answer(1, 0, "b") == Answer(False, "another page drives")
    # 3. A release counts, however late; another page drives after a while without requests.
    count = len(rover.twists)
    assert answer(0, 0, late_ms=5000) == Answer(True, "the stick is released: it stands")
    wait_until(lambda: len(rover.twists) > count)
    assert rover.twists[count:] == [(0.0, 0.0)]
    takes_ms[0], page._held_until_s = 0, 0.0
    assert answer(1, 0, "b").done


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
    assert not answer.done and words in answer.text and not rover.topics


class Navigator:
    """A robot that grants every request but those for the route `lost`, and whose disk is full at the second save."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.asked, self.goals = bus, list[str](), list[PlanarPath]()
        self.twists: list[tuple[float, float]] = []
        self.state = "driving"
        bus.subscribe_commands(self._take, command_topics(("operator",)))

    def _take(self, request: Request) -> None:
        if request.topic == "cmd/twist":
            command = codec.twist_from_cdr(request.payload)
            self.twists.append((command.velocity_mps, command.yaw_rate_radps))
            return
        if request.topic == "cmd/goal":
            self.goals.append(goal_from_cdr(request.payload))
            self._bus.answer(request.id, Answer(True, "it drives there"))
            return
        text = string_from_cdr(request.payload)
        self.asked.append(text)
        is_refused = text.endswith("lost") or self.asked.count("save") == 2
        self._bus.answer(request.id, Answer(not is_refused, "that cannot be" if is_refused else f"does {text}"))

    def publish(self) -> None:
        """Report the navigation, and that it is armed."""
        wheels = DiagnosticStatus(WHEELS, 0, "driving", {Key.ARMED: "1"})
        self._bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [wheels]))
        values = {Key.STATE: self.state, Key.REASON: "", Key.TASK: "route dock", Key.LEFT_M: "3.5"}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        self._bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


@pytest.fixture(scope="module")
def answering() -> Iterator[tuple[WebServer, Navigator]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        navigator = Navigator(bus)
        Shown(server).until("navigation", navigator.publish)
        yield server, navigator


def answer(answering: tuple[WebServer, Navigator], path: str, text: str) -> dict[str, Any]:
    """Return the answer to a request."""
    server, _ = answering
    found: dict[str, Any] = json.loads(server.request(path, "POST", server.bearer, text).text)
    return found


def test_requests_reach_the_robot_and_its_answer_the_page(answering: tuple[WebServer, Navigator]) -> None:
    server, navigator = answering
    for path, text, moves in (
        ("/route", "teach dock", False),
        ("/route", "finish", False),
        ("/route", "repeat dock", True),
        ("/route", "stop", False),
        ("/navigation", "pause", False),
        ("/navigation", "resume", True),
    ):
        stamp = f" stamp={server.state_ms()}" if moves else ""
        assert answer(answering, path, f"{text}{stamp}") == {"done": True, "text": f"does {text}"}
        assert navigator.asked[-1] == text
    refused = answer(answering, "/route", f"repeat lost stamp={server.state_ms()}")
    assert not refused["done"] and refused["text"] == "omnid refuses: that cannot be"
    shown = Shown(server).until("navigation", navigator.publish)
    assert (shown["state"], shown["task"], shown["left_m"]) == ("driving", "route dock", 3.5)


NODE = shutil.which("node")
PATIENCE_S = 30.0
# A document of elements that remember what is shown; it ends when the button shows an answer of the server.
PRESS = """
const shown = [];
const element = (id) => ({ classList: { add() {}, remove() {} }, addEventListener(name, act) { this[name] = act; },
  set textContent(text) { if (id === "stop-answer" && shown.at(-1) !== text) shown.push(text); } });
const elements = {};
globalThis.document = { getElementById: (id) => (elements[id] ??= element(id)), addEventListener() {} };
const send = fetch;
globalThis.fetch = (address, options) => send(`http://127.0.0.1:${process.argv[2]}/${address}`, options);
const { wireStop } = await import("./commands.js");
wireStop();
elements.stop.pointerdown();
setInterval(() => {
  if (!shown.at(-1)?.startsWith("the robot stops")) return;
  console.log(JSON.stringify(shown));
  process.exit(0);
}, 20);
"""


@pytest.mark.hazard("H46")
@pytest.mark.skipif(NODE is None, reason="needs node")
def test_a_stop_on_a_connection_that_is_lost_is_sent_on_another_one(tmp_path: Path) -> None:
    """A network that has gone ends no request for minutes: it gets no answer, and no error."""
    for script in ("commands.js", "elements.js"):
        shutil.copy(STATIC / script, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "press.js").write_text(PRESS)
    asked, ended = list[str](), threading.Event()

    class Lossy(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.append(self.path)
            if len(asked) == 1:
                ended.wait(PATIENCE_S)
                return
            body = json.dumps({"done": True, "text": "the robot stops"}).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Lossy)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        found = subprocess.run(
            [str(NODE), str(tmp_path / "press.js"), str(server.server_port)],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
    finally:
        ended.set()
        server.shutdown()
        thread.join()
        server.server_close()
    first, *_, last = shown = json.loads(found.stdout)
    assert first == "sending STOP ..." and last == "the robot stops"
    assert any("use the emergency stop" in text for text in shown[1:-1]), "the operator is told meanwhile"
    assert len(asked) > 1 and set(asked) == {"/stop"}
