"""Stops, the stick, requests and news of a page, with a robot on the bus of the same process; STOP in node."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client import parser

from calib import se3
from drivers.frame import Frame
from omnid.monitor.robot_state import RobotState
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import (
    Diagnostics,
    DiagnosticStatus,
    Pose,
    PoseAttachment,
    Scan,
    scan_cdr,
    string_from_cdr,
)
from omnid.transport.sensor_codec import image_cdr
from omnid.transport.status_names import NAVIGATION, ODOMETRY, PLACES, WHEELS, Key
from omnid.transport.topics import Answer, Request
from omnid.web.feed import RobotFeed, scan_news, state_news
from omnid.web.server import STATIC, metrics
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from starlette.requests import Request as WebRequest
from starlette.routing import Route

from omnid.client import Robot
from omnid.monitor.teleop import Stick
from omnid.web import feed, robot
from omnid.web.robot import RobotPage
from tests.waiting import wait_until

NOW_MS = 50_000
LATE_MS = NOW_MS - 1001


class Rover:
    """A robot that keeps what it is asked for, and confirms stops where it is told to."""

    def __init__(self, bus: Bus, endpoint: str) -> None:
        self._bus, self.endpoint = bus, endpoint
        self.topics, self.twists = list[str](), list[tuple[float, float]]()
        self.texts, self.is_stopped, self.is_granted = list[str](), False, True
        bus.serve("config", "[controller.limits]\nvelocity_mps = 0.7\nyaw_rate_radps = 1.5\n")
        bus.subscribe_commands(self._take, lambda: self.is_stopped)

    def _take(self, request: Request) -> None:
        self.topics.append(request.topic)
        if request.topic == "cmd/twist":
            command = codec.twist_from_cdr(request.payload)
            self.twists.append((command.velocity_mps, command.yaw_rate_radps))
        elif request.topic != "cmd/stop":
            if request.topic in ("cmd/route", "cmd/navigation"):
                self.texts.append(string_from_cdr(request.payload))
            self._bus.answer({request.id: Answer(self.is_granted, "as asked" if self.is_granted else "a fault holds")})

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
    with Robot(settings=feed.bus) as connection:
        feed.robot, feed.link = connection, ""
        connection.driver().require_connected()
        yield RobotPage(feed)


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


def test_a_stop_ends_once_it_is_confirmed_whoever_asks_for_it(rover: Rover) -> None:
    wheels = RobotPage(rover.feed())

    async def stops() -> list[Answer]:
        first = asyncio.create_task(wheels.stop())
        await until(lambda: "cmd/stop" in rover.topics)
        assert wheels.is_stopping and not first.done()
        others = [asyncio.create_task(wheels.stop()) for _ in range(2)]
        gone = asyncio.create_task(wheels.stop())
        await asyncio.sleep(0)
        gone.cancel()  # a browser that goes
        rover.is_stopped = True
        answers = await asyncio.gather(first, *others)
        assert not wheels.is_stopping
        return answers

    assert asyncio.run(stops()) == [Answer(True, "the robot stops: its wheels stay stopped until it is armed")] * 3


def test_the_stick_sends_a_share_of_the_limits(rover: Rover, page: RobotPage, clock_ms: list[int]) -> None:
    mps, radps = Stick.share * 0.7, Stick.share * 1.5

    def answer(forward: float, turn: float, name: str = "a", late_ms: int = 0) -> Answer:
        return post(page, "/drive", f"{forward:g} {turn:g} {clock_ms[0] - late_ms} {name}")

    for forward, turn, words in (
        (1.0, -0.5, f"it drives by the stick: {mps:+.2f} m/s, {-28.6479 * radps:+.0f}°/s"),
        (-0.25, 0.0, f"it drives by the stick: {-0.25 * mps:+.2f} m/s, +0°/s"),
        (0.0, 1.0, f"it drives by the stick: +0.00 m/s, {57.2958 * radps:+.0f}°/s"),
    ):
        count = len(rover.twists)
        assert answer(forward, turn) == Answer(True, words)
        wait_until(partial(rover.has_more_than, count))
        assert rover.twists[count:] == [pytest.approx((forward * mps, turn * radps))]
    page._held_until_s = math.inf
    assert answer(1, 0, "b") == Answer(False, "another page drives")
    # A release counts, however late; another page drives after a while without requests.
    count = len(rover.twists)
    assert answer(0, 0, late_ms=5000) == Answer(True, "the stick is released: the robot stops")
    wait_until(lambda: len(rover.twists) > count)
    assert rover.twists[count:] == [(0.0, 0.0)]
    page._held_until_s = 0.0
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
def test_requests_that_move_the_robot_are_refused_late_or_without_a_stamp(
    rover: Rover, page: RobotPage, path: str, text: str, words: str
) -> None:
    answer = post(page, path, text)
    assert not answer.done and words in answer.text and not rover.topics


def test_requests_reach_the_robot_and_its_answer_the_page(rover: Rover, page: RobotPage) -> None:
    for path, text, needs_stamp in (
        ("/route", "teach dock", True),
        ("/route", "finish", False),
        ("/route", "repeat dock", True),
        ("/route", "stop", False),
        ("/navigation", "pause", False),
        ("/navigation", "resume", True),
    ):
        assert post(page, path, f"{text} stamp={NOW_MS}" if needs_stamp else text) == Answer(True, "as asked")
        assert rover.texts[-1] == text
    rover.is_granted = False
    refused = post(page, "/route", f"repeat dock stamp={NOW_MS}")
    assert refused == Answer(False, "omnid refuses: a fault holds")


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


# Messages.


def pose(stamp_ns: int, x_m: float, y_m: float, yaw: float, sent_ns: int = 5_000_000) -> Pose:
    """Return a pose with standard deviations of 1 to 6 mm and mrad, at 0.3 m/s."""
    T = se3.transform(se3.rotation_exp([0, 0, yaw]), [x_m, y_m, 0.1])
    covariance = np.diag([1e-6, 4e-6, 9e-6, 16e-6, 25e-6, 36e-6])
    velocity = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.1])
    attachment = PoseAttachment(7, "tracking", 2, 40, 50, sent_ns)
    return Pose(stamp_ns, T, covariance, velocity, np.eye(6), attachment, stamp_ns + 60_000_000)


def state(*statuses: DiagnosticStatus) -> RobotState:
    found = RobotState()
    found.add_diagnostics(Diagnostics(0, statuses))
    return found


def shown(robot: RobotState, link: str = "") -> dict[str, Any]:
    return state_news("rover", robot, link)


def test_warnings_come_with_the_worst_first_and_with_their_remedies() -> None:
    robot = state(
        DiagnosticStatus(PLACES, 1, "lost", {Key.REMEDY: "drive back"}),
        DiagnosticStatus(ODOMETRY, 0, "well", {}),
        DiagnosticStatus(WHEELS, 2, "a fault", {Key.REMEDY: "press the button"}),
    )
    robot.set_alive(True)
    found = shown(robot)["warnings"]
    assert [(one["level"], one["message"]) for one in found] == [(2, "a fault"), (1, "lost")]
    assert found[0]["remedy"] == "press the button" and found[1]["remedy"] == "drive back"
    assert shown(robot)["in_map"] == "lost" and shown(state())["in_map"] is None
    robot.set_alive(False)
    first = shown(robot)["warnings"][0]
    assert (first["level"], first["name"]) == (2, "robot") and "omnid run" in first["remedy"]
    first = shown(robot, "no route")["warnings"][0]
    assert (first["level"], first["name"], first["message"]) == (2, "connection", "no route")
    assert len(shown(robot, "no route")["warnings"]) == 1, "one of both only, and none of a daemon that has ended"


def scan(ranges: list[float], azimuths: list[float], frame: str = "base_link", stamp_ns: int = 100) -> Scan:
    return Scan(stamp_ns, frame, np.array(azimuths), np.array(ranges), np.array([]), 8.0)


def test_obstacles_are_drawn_from_the_pose_nearest_in_time() -> None:
    poses = [pose(10, 9.0, 9.0, 0.0), pose(90, 1.0, 2.0, math.pi / 2), pose(300, 5.0, 5.0, 0.0)]
    ranges = [2.0, math.nan, math.inf, 0.0, -1.0, 1.5, 2e4]
    azimuths = [0.0, 0.1, 0.2, 0.3, 0.4, 3 * math.pi / 2, 0.5]
    found = scan_news(scan(ranges, azimuths), poses)
    np.testing.assert_allclose(found["points"], [(1.0, 4.0), (2.5, 2.0)], atol=1e-3)
    assert found["nearest"] == pytest.approx([1.5, -90.0])
    no_scan = {"points": [], "nearest": None}
    assert scan_news(scan(ranges, azimuths, "map"), poses) == no_scan
    assert scan_news(scan(ranges, azimuths), []) == no_scan
    assert scan_news(scan([math.inf], [0.0]), poses) == no_scan


# The feed.


MAP = codec.grid_cdr(10**18, "odom", np.full((4, 3), 100, np.int8), 0.1, (-1.0, -2.0))
SCAN = scan_cdr(10**9, "base_link", np.ones(360, np.float32), np.ones(360, np.float32), (0.1, 6.0))


def panorama(data: bytes) -> bytes:
    return bytes(image_cdr(Frame(1, 10**9, "lower", "jpeg", np.frombuffer(data, np.uint8)), 10**9)[1])


def add_pose(feed: RobotFeed, seq: int, run: str = "a") -> None:
    """Put a pose at 0.25 m times seq into the inbox."""
    feed.state.put("odom", odometry(seq), PoseAttachment(seq, "tracking", 0, 50, 60, time.time_ns(), run).to_bytes())


def test_a_robot_that_has_started_again_is_shown_without_what_belongs_to_its_odom_before() -> None:
    """Its run is another one, for which the pages load again, and there is no map, scan, navigation or panorama."""
    feed = RobotFeed(BusConfig())
    navigation = DiagnosticStatus(NAVIGATION, 0, "", {str(Key.STATE): "driving", "task": "goal"})
    large = {
        "map": MAP,
        "scan": SCAN,
        "panorama": panorama(b"\xff\xd8 bytes"),
        "path": codec.path_cdr(10**9, "odom", [(0.0, 0.0), (1.0, 0.0)]),
        "navigation": codec.diagnostics_cdr(10**18, [navigation]),
    }
    add_pose(feed, 0)
    add_pose(feed, 4)
    feed.state.put(
        "map_pose", codec.encoded(codec.MAP_POSE_SCHEMA, (10**9 + 4, "map"), (np.eye(4), np.eye(6).ravel())), b""
    )
    for topic, payload in large.items():
        feed.state.put(topic, payload, b"")
    feed.process_inbox()
    news = feed.news(0)
    assert news["state"]["map_in_odom"] is not None and news["map"]["width"] == 3 and news["panorama"]
    assert news["scan"]["points"] and news["navigation"]["task"] == "goal" and len(news["path"]) == 2
    add_pose(feed, 5, "b")
    feed.process_inbox()
    news = feed.news(0)
    assert news["state"]["map_in_odom"] is None and news["state"]["run"] == "b" and not news.keys() & large.keys()


def test_numbers_of_the_status_with_labels_that_cannot_break_out() -> None:
    state = RobotState()
    state.alive = True
    values = {"rate_hz": "29.5", "mode": "640x480", "bad": "nan", 'a"} 1\nomnid_up 0': "7"}
    state.add_diagnostics(Diagnostics(1, (DiagnosticStatus("omnid: odometry", 1, "x", values),)))
    families = parser.text_string_to_metric_families(metrics(state))
    found = {(one.name, *one.labels.values()): one.value for family in families for one in family.samples}
    assert found["omnid_up",] == 1 and found["omnid_status_level", "odometry"] == 1
    assert sorted(value for labels, value in found.items() if labels[0] == "omnid_status_value") == [7.0, 29.5]
