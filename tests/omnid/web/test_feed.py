"""From the robot's messages to what browsers are sent, without a program: path, messages, feed, browsers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh
from starlette.websockets import WebSocket

from calib import se3
from drivers.frame import Frame
from omnid.monitor.robot_state import RobotState
from omnid.transport import codec, map_codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.decode import Diagnostics, Map, NavigationReport, Pose, PoseInMap
from omnid.transport.image_codec import image_cdr
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.scan_codec import Scan, scan_cdr
from omnid.transport.status_names import NAVIGATION, ODOMETRY, PLACES, WHEELS, Key
from omnid.web import browsers as browsers_module
from omnid.web import feed as feed_module
from omnid.web.browsers import Browsers
from omnid.web.channels import MOST_POINTS, LivePath, Newest, compact, with_header
from omnid.web.feed import RobotFeed
from omnid.web.snapshot import (
    LARGEST_MAP_PX,
    LONGEST_VALUE,
    MOST_CELLS,
    MOST_VALUES,
    MOST_WARNINGS,
    map_in_odom,
    map_message,
    navigation_message,
    parts_message,
    scan_message,
    state_message,
)
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry

# The path.


def follow(path: LivePath, shown: list[list[float]], seen: int) -> int:
    """Apply the next message as the page does; return the version that is seen then."""
    message = json.loads(path.message(seen))
    assert message["from"] <= len(shown)
    shown[message["from"] :] = message["points"]
    return path.version


def test_browsers_that_come_at_any_time_show_the_same_path() -> None:
    path = LivePath()
    shown: dict[int, list[list[float]]] = {1: [], 7: [], 100: []}
    seen = dict.fromkeys(shown, 0)
    for step in range(20_000):
        path.add(0.01 * step, math.sin(0.01 * step), gap=step in (500, 15_000))
        if step == 9000:
            path.clear()
        for every in shown:
            if step % every == 0:
                seen[every] = follow(path, shown[every], seen[every])
    for every, points in shown.items():
        follow(path, points, seen[every])
    assert shown[1] == shown[7] == shown[100] and 1000 < len(shown[1]) <= MOST_POINTS
    assert sum(len(point) > 2 for point in shown[1]) == 1 and shown[1][0][0] == pytest.approx(90.01, abs=0.1)


def test_a_path_of_nothing_but_gaps_and_of_wrong_numbers_stays_small() -> None:
    path = LivePath()
    for step in range(3 * MOST_POINTS):
        path.add(float(step % 1000), 0.0, gap=True)
        path.add(math.nan, 0.0)
        path.add(1e300, -math.inf)
    message = json.loads(path.message(0))
    assert 0 < len(message["points"]) <= MOST_POINTS


def test_json_has_no_number_that_is_not_finite() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        compact({"x": math.nan})
    assert with_header({"type": "map"}, b"\0") == b'\0\0\0\x0e{"type":"map"}\0'


def test_a_gap_is_a_jump_of_more_than_a_metre_or_ten_steps() -> None:
    path = LivePath()
    for x_m in (0.0, 0.9, 1.9, 3.0):
        path.add(x_m, 0.0)
    assert json.loads(path.message(0))["points"] == [[0.0, 0.0], [0.9, 0.0], [1.9, 0.0], [3.0, 0.0, 1]]
    path._path.step_m = 0.5
    for x_m in (7.5, 12.6):
        path.add(x_m, 0.0)
    assert json.loads(path.message(0))["points"][-2:] == [[7.5, 0.0], [12.6, 0.0, 1]]


def test_the_message_begins_after_what_was_seen_and_with_all_after_a_clear() -> None:
    path = LivePath()
    for x_m in (0.0, 0.5, 1.00049):
        path.add(x_m, -x_m)
    assert path.version == 3
    assert json.loads(path.message(2)) == {"type": "path", "from": 2, "points": [[1.0, -1.0]]}
    assert [json.loads(path.message(seen))["from"] for seen in (0, 1, 3)] == [0, 1, 3]
    path.clear()
    assert path.version == 4
    path.add(7.0, 0.0)
    assert path.version == 5
    assert [json.loads(path.message(seen))["from"] for seen in (0, 3, 4, 5)] == [0, 0, 0, 1]
    assert json.loads(path.message(3))["points"] == [[7.0, 0.0]]


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
    message: dict[str, Any] = json.loads(state_message("rover", robot, link, {"more": 3}))
    return message


def test_the_state_names_pose_speed_and_uncertainty() -> None:
    robot = state()
    assert shown(robot)["pose"] is None and not shown(robot)["fresh"] and shown(robot)["more"] == 3
    robot.pose = pose(0, 1.5, -2.0, 0.5)
    found = shown(robot)["pose"]
    assert (found["x_m"], found["y_m"], found["z_m"], found["speed_mps"]) == (1.5, -2.0, 0.1, 0.3)
    assert found["yaw_rad"] == pytest.approx(0.5) and found["sigma_mm"] == pytest.approx(3.0)
    assert found["sigma_deg"] == pytest.approx(math.degrees(0.006), rel=1e-5)
    assert (found["inliers"], found["tracked"], found["resets"], found["sent_ms"]) == (40, 50, 2, 5.0)
    for sent_ns, sent_ms in ((0, None), (-1, None), (1, 1e-6), (2**63, None)):
        robot.pose = pose(0, 0.0, 0.0, 0.0, sent_ns)
        assert shown(robot)["pose"]["sent_ms"] == sent_ms


@pytest.mark.parametrize(
    ("values", "alive", "armed"),
    [
        ({Key.ARMED: "1"}, True, True),
        ({Key.ARMED: "0"}, None, False),
        ({}, True, False),
        ({Key.ARMED: "1"}, False, None),
    ],
)
def test_the_wheels_count_as_armed_only_where_the_robot_says_so(
    values: dict[str, str], alive: bool | None, armed: bool | None
) -> None:
    robot = state(DiagnosticStatus(WHEELS, 1, "a person stands in the way", {**values, Key.SOURCE: "planner"}))
    if alive is not None:
        robot.set_alive(alive)
    found = shown(robot)["wheels"]
    expected = {"armed": armed, "message": "a person stands in the way", "level": 1, "source": "planner"}
    assert found == (None if armed is None else expected)
    assert shown(state())["wheels"] is None


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
    assert len(shown(robot, "no route")["warnings"]) == 3, "one of both only"
    many = state(*(DiagnosticStatus(f"omnid: {k}", 1, "", {}) for k in range(MOST_WARNINGS + 5)))
    assert len(shown(many)["warnings"]) == MOST_WARNINGS


def test_all_parts_are_listed_with_the_worst_first_and_stages_last() -> None:
    stage = DiagnosticStatus("omnid: stage x", 0, "", {})
    robot = state(
        stage,
        DiagnosticStatus("omnid: b", 0, "", {f"k{n}": "v" * 200 for n in range(MOST_VALUES + 5)}),
        DiagnosticStatus("omnid: a", 0, "", {}),
        DiagnosticStatus("omnid: c", 6, "", {}),
    )
    parts = json.loads(parts_message(robot))["parts"]
    assert [part["name"] for part in parts] == ["c", "a", "b", "stage x"] and parts[0]["level"] == 2
    assert len(parts[2]["values"]) == MOST_VALUES
    assert all(len(value) <= LONGEST_VALUE for entry in parts[2]["values"] for value in entry)


def test_the_origin_of_the_map_in_odom_follows_from_two_poses_of_the_same_time() -> None:
    T_map_base = se3.transform(se3.rotation_exp([0, 0, 0.2]), [4.0, 1.0, 0.0])
    poses = [pose(10, 9.0, 9.0, 9.0), pose(20, 1.0, 2.0, 0.9)]
    found = map_in_odom(PoseInMap(20, T_map_base, np.eye(6)), poses)
    assert found is not None
    c, s = math.cos(0.7), math.sin(0.7)
    assert found == pytest.approx([1.0 - (4.0 * c - s), 2.0 - (4.0 * s + c), 0.7], rel=1e-5)
    assert map_in_odom(PoseInMap(15, T_map_base, np.eye(6)), poses) is None


def unpacked(message: bytes) -> tuple[dict[str, Any], bytes]:
    """Return header and content of a message."""
    size = int.from_bytes(message[:4], "big")
    return json.loads(message[4 : 4 + size]), message[4 + size :]


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_a_map_is_sent_as_unknown_free_and_occupied_cells(frame: str) -> None:
    cells = np.array([[-1, 0, 50], [51, 100, 30]], np.int8)
    header, content = unpacked(map_message(Map(0, frame, cells, 0.05, (-1.0, 2.0))))
    assert header == {
        "type": "map",
        "width": 3,
        "height": 2,
        "frame": frame,
        "cell_m": 0.05,
        "x_m": -1.0,
        "y_m": 2.0,
        "known": [-1.0, 2.0, pytest.approx(-0.85), pytest.approx(2.1)],
    }
    assert list(zlib.decompress(content)) == [0, 1, 1, 2, 2, 1]


def test_a_large_map_is_reduced_and_loses_no_obstacle() -> None:
    cells = np.zeros((3, LARGEST_MAP_PX + 1), np.int8)
    cells[2, -1] = cells[0, 3] = 100
    header, content = unpacked(map_message(Map(0, "odom", cells, 0.05, (0.0, 0.0))))
    assert (header["width"], header["height"], header["cell_m"]) == (LARGEST_MAP_PX // 2 + 1, 2, 0.1)
    small = np.frombuffer(zlib.decompress(content), np.uint8).reshape(2, -1)
    assert np.argwhere(small == 2).tolist() == [[0, 1], [1, LARGEST_MAP_PX // 2]]
    header, content = unpacked(map_message(Map(0, "odom", cells[:, 1:], 0.05, (0.0, 0.0))))
    assert header["width"] == LARGEST_MAP_PX and header["cell_m"] == 0.05


@pytest.mark.parametrize(
    "grid",
    [
        Map(0, "other", np.zeros((2, 2), np.int8), 0.05, (0.0, 0.0)),
        Map(0, "odom", np.zeros((0, 2), np.int8), 0.05, (0.0, 0.0)),
        Map(0, "odom", np.zeros((2, 2), np.int8), math.nan, (0.0, 0.0)),
        Map(0, "odom", np.zeros((2, 2), np.int8), 0.05, (0.0, math.inf)),
    ],
)
def test_a_map_that_cannot_be_drawn_is_sent_without_cells(grid: Map) -> None:
    header, content = unpacked(map_message(grid))
    assert (header["width"], header["height"], content) == (0, 0, b"")


def scan(ranges: list[float], azimuths: list[float], frame: str = "base_link", stamp_ns: int = 100) -> Scan:
    return Scan(stamp_ns, frame, np.array(azimuths), np.array(ranges), np.array([]), 8.0)


def test_obstacles_are_drawn_from_the_pose_nearest_in_time() -> None:
    poses = [pose(10, 9.0, 9.0, 0.0), pose(90, 1.0, 2.0, math.pi / 2), pose(300, 5.0, 5.0, 0.0)]
    ranges = [2.0, math.nan, math.inf, 0.0, -1.0, 1.5, 2e4]
    azimuths = [0.0, 0.1, 0.2, 0.3, 0.4, 3 * math.pi / 2, 0.5]
    found = json.loads(scan_message(scan(ranges, azimuths), poses))
    np.testing.assert_allclose(found["points"], [(1.0, 4.0), (2.5, 2.0)], atol=1e-3)
    assert found["nearest"] == pytest.approx([1.5, -90.0])
    nothing = {"type": "scan", "points": [], "nearest": None}
    assert json.loads(scan_message(scan(ranges, azimuths, "map"), poses)) == nothing
    assert json.loads(scan_message(scan(ranges, azimuths), [])) == nothing
    assert json.loads(scan_message(scan([math.inf], [0.0]), poses)) == nothing


def test_the_state_of_a_drive_and_of_a_recording() -> None:
    report = NavigationReport(1, "blocked", "it waits", "route dock", 5, math.nan, "goal", "no", "hall", 2.5)
    assert json.loads(navigation_message(report)) == {
        "type": "navigation",
        "state": "blocked",
        "reason": "it waits",
        "task": "route dock",
        "left_m": None,
        "teaching": "hall",
        "taught_m": 2.5,
        "refusal": "no",
    }


# The feed.


STATUS = codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 0, "armed", {Key.ARMED: "1"})])
MAP = map_codec.grid_cdr(10**18, "odom", np.full((4, 3), 100, np.int8), 0.1, (-1.0, -2.0))
SCAN = scan_cdr(10**9, "base_link", np.ones(360, np.float32), np.ones(360, np.float32), (0.1, 6.0))


def panorama(data: bytes) -> bytes:
    return bytes(image_cdr(Frame(1, 10**9, "lower", "jpeg", np.frombuffer(data, np.uint8)), 10**9)[1])


def add_pose(feed: RobotFeed, seq: int, resets: int = 0) -> None:
    """Put a pose at 0.25 m times seq into the inbox."""
    feed.inbox.put("odom", odometry(seq), PoseAttachment(seq, "tracking", resets, 50, 60, time.time_ns()).to_bytes())


def points(feed: RobotFeed) -> list[list[float]]:
    return list(json.loads(feed.path.message(0))["points"])


async def until(condition: Callable[[], object]) -> None:
    """Let the event loop go on until a condition holds."""
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s
        await asyncio.sleep(0.001)


def test_a_message_is_refused_from_its_limit_on_and_the_newest_large_one_counts() -> None:
    async def check() -> None:
        feed = RobotFeed(BusConfig())
        receive = feed._receiver(asyncio.get_running_loop())
        limits = {
            "odom": 1 << 16,
            "map_pose": 1 << 16,
            "status": 1 << 20,
            "scan": 1 << 20,
            "map": MOST_CELLS + (1 << 16),
            "panorama": 1 << 23,
            "navigation": 1 << 16,
        }
        for broken, (topic, limit) in enumerate(limits.items(), 1):
            receive(topic, bytes(limit), b"")
            assert feed.state.broken == broken - 1, topic
            receive(topic, bytes(limit + 1), b"")
            assert feed.state.broken == broken, topic
        receive("elsewhere", b"", b"")
        receive("elsewhere", b"1", b"")
        assert feed.state.broken == len(limits) + 1
        assert set(feed._large) == {"scan", "map", "panorama", "navigation"}
        receive("scan", b"new", b"")
        assert feed._large["scan"] == b"new"
        taken = iter(lambda: feed.inbox.get(0.0), None)
        assert [message.topic for message in taken] == ["odom", "map_pose", "status", "elsewhere"]
        await asyncio.sleep(0)
        assert feed._wake.is_set() and feed._large_wake.is_set()

    asyncio.run(check())


def test_the_path_begins_again_with_a_smaller_number_and_has_a_gap_after_a_reset() -> None:
    feed = RobotFeed(BusConfig())
    for seq, resets in ((5, 0), (6, 0), (6, 0), (7, 1), (8, 1)):
        add_pose(feed, seq, resets)
    feed._process_inbox()
    assert points(feed) == [[1.25, -1.0], [1.5, -1.0], [1.75, -1.0, 1], [2.0, -1.0]]
    assert len(feed._poses) == 5
    add_pose(feed, 1, 1)
    add_pose(feed, 2, 1)
    feed._process_inbox()
    assert points(feed) == [[0.25, -1.0], [0.5, -1.0]] and len(feed._poses) == 2


def test_a_robot_that_has_started_again_is_shown_without_what_belongs_to_its_odom_before() -> None:
    """The pages are sent messages without a map, obstacles, navigation and panorama, in place of the old ones."""
    feed = RobotFeed(BusConfig())
    navigation = DiagnosticStatus(NAVIGATION, 0, "", {str(Key.STATE): "driving", str(Key.TASK): "goal"})
    large = {
        "map": MAP,
        "scan": SCAN,
        "panorama": panorama(b"\xff\xd8 bytes"),
        "navigation": codec.diagnostics_cdr(10**18, [navigation]),
    }
    channels = (feed._map_channel, feed._scan_channel, feed._panorama_channel, feed._navigation_channel)

    async def take() -> None:
        for topic, payload in large.items():
            await feed._take_large(topic, payload)

    for seq in (4, 0):  # with nothing to forget there is nothing to send
        add_pose(feed, seq)
    feed._process_inbox()
    assert [channel.version for channel in channels] == [0, 0, 0, 0]
    add_pose(feed, 4)
    feed.inbox.put("map_pose", codec.pose_with_covariance_cdr(10**9 + 4, np.eye(4), np.eye(6)), b"")
    feed._process_inbox()
    asyncio.run(take())
    assert feed._map_in_odom is not None and [channel.version for channel in channels] == [1, 1, 1, 1]
    add_pose(feed, 0)
    feed._process_inbox()
    assert [channel.version for channel in channels] == [2, 2, 2, 2]
    assert json.loads(feed._encode_state())["map_in_odom"] is None
    no_map, no_panorama = (bytes(channel.message(1)[4:]) for channel in (feed._map_channel, feed._panorama_channel))
    assert json.loads(no_map) == {"type": "map", "width": 0, "height": 0, "frame": "odom"}
    assert json.loads(no_panorama) == {"type": "panorama", "stamp_ms": 0}
    assert json.loads(feed._scan_channel.message(1)) == {"type": "scan", "points": [], "nearest": None}
    report = json.loads(feed._navigation_channel.message(1))
    assert (report["state"], report["task"], report["left_m"]) == ("", "", None)


def test_a_status_makes_new_parts_and_a_daemon_that_has_ended_takes_them_along() -> None:
    feed = RobotFeed(BusConfig())
    add_pose(feed, 1)
    feed._process_inbox()
    assert feed._parts_channel.version == 0
    feed.inbox.put("status", STATUS, b"")
    feed._process_inbox()
    assert feed._parts_channel.version == 1 and WHEELS in feed.state.statuses
    for alive in (None, True):
        feed.state.alive = alive
        feed._forget_ended()
        assert feed.state.statuses
    feed.state.alive = False
    feed._forget_ended()
    assert not feed.state.statuses and feed._parts_channel.version == 2
    feed._forget_ended()
    assert feed._parts_channel.version == 2
    feed.inbox.put("map_pose", b"nonsense", b"")
    feed._process_inbox()
    assert feed.state.broken == 1


@pytest.mark.parametrize("has_map", [True, False])
def test_it_follows_a_robot_from_what_was_published_before(monkeypatch: pytest.MonkeyPatch, has_map: bool) -> None:
    monkeypatch.setattr(feed_module, "REQUEST_S", 0.001)
    monkeypatch.setattr(feed_module, "QUIET_S", 0.02)
    endpoint = free_endpoint()

    async def check(bus: Bus) -> RobotFeed:
        bus.publish("status", STATUS)
        if has_map:
            bus.publish("map", MAP)
        feed = RobotFeed(BusConfig(connect=(endpoint,)))
        following = asyncio.create_task(feed.run())
        await until(lambda: feed._map_channel.version if has_map else feed._parts_channel.version)
        assert not feed.link and WHEELS in feed.state.statuses and feed._parts_channel.version
        await until(lambda: feed.state.alive)
        shown = feed._state_channel.version
        await until(lambda: feed._state_channel.version > shown + 1)  # without a message
        # A panorama is subscribed to while a browser asks for it.
        browser = browsers_module._Browser([])
        feed.browsers._open.add(browser)
        assert not bus.is_received("panorama")
        browser.wanted.add("panorama")
        await until(lambda: bus.is_received("panorama"))
        bus.publish("panorama", panorama(b"\xff\xd8 bytes"))
        await until(lambda: feed._panorama_channel.version)
        end = feed._end_panorama
        assert end is not None and feed.robot is not None
        await feed._follow_requests(feed.robot, feed._receiver(asyncio.get_running_loop()))
        assert feed._end_panorama is end, "it goes on while it is asked for"
        browser.wanted.clear()
        await until(lambda: not bus.is_received("panorama"))
        assert feed._end_panorama is None
        bus.publish("scan", SCAN)
        await until(lambda: feed._scan_channel.version)
        following.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await following
        return feed

    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        feed = asyncio.run(check(bus))
    assert feed.robot is not None
    with pytest.raises(zenoh.ZError):
        feed.robot.driver()  # the connection is closed


def channels(*names: str) -> list[Newest]:
    """Return channels whose messages are their names and versions."""
    found = [Newest(name, lambda: "") for name in names]
    for channel in found:
        channel._encode = lambda channel=channel: f"{channel.name} {channel.version}"  # type: ignore[misc]
    return found


# Browsers.


class Page:
    """A browser: what it was sent, and what it sends."""

    def __init__(self, browsers: Browsers) -> None:
        self.sent: list[dict[str, Any]] = []
        self._events: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._events.put_nowait({"type": "websocket.connect"})
        scope = {"type": "websocket", "path": "/live", "headers": []}
        self.serving = asyncio.create_task(browsers.serve(WebSocket(scope, self._events.get, self._send)))

    async def _send(self, message: Any) -> None:
        self.sent.append(message)

    def say(self, text: str) -> None:
        self._events.put_nowait({"type": "websocket.receive", "text": text})

    def leave(self) -> None:
        self._events.put_nowait({"type": "websocket.disconnect", "code": 1000})

    @property
    def texts(self) -> list[str]:
        """The messages so far."""
        return [message["text"] for message in self.sent if message["type"] == "websocket.send"]

    @property
    def closed(self) -> int:
        """The code with which it was closed, 0 if it was not."""
        return int(self.sent[-1]["code"]) if self.sent and self.sent[-1]["type"] == "websocket.close" else 0


def shows(page: Page, text: str) -> bool:
    """True if the newest message of a browser has a text."""
    return bool(page.texts) and text in page.texts[-1]


def test_a_browser_gets_the_newest_message_of_each_kind_once_it_has_answered() -> None:
    async def check() -> None:
        state, extra = channels("state", "extra")
        browsers = Browsers((state, extra), frozenset(("extra",)))
        page = Page(browsers)
        await until(lambda: len(browsers) == 1)
        state.changed()
        extra.changed()
        browsers.notify()
        await until(lambda: page.texts)
        for _ in range(3):
            state.changed()
            browsers.notify()
        await asyncio.sleep(0)
        assert page.texts == ["state 1"] and not browsers.want("extra")
        page.say("ok")
        await until(lambda: len(page.texts) > 1)
        assert page.texts == ["state 1", "state 4"] and browsers.skipped == {"state": 2}
        page.say("show extra")
        page.say("ok")
        await until(lambda: len(page.texts) > 2)
        assert page.texts[2] == "extra 1" and browsers.want("extra") and browsers.sent == {"state": 2, "extra": 1}
        assert browsers.answer.count == 2 and browsers.answer.p(1.0) < 10.0
        page.say("hide extra")
        page.say("ok")
        await until(lambda: not browsers.want("extra"))
        extra.changed()
        state.changed()
        browsers.notify()
        await until(lambda: len(page.texts) > 3)
        assert page.texts[3] == "state 5"
        page.leave()
        await page.serving
        assert not len(browsers) and not page.closed and not browsers.closed

    asyncio.run(check())


@pytest.mark.parametrize("text", ["ok", "show state", "hide", "show", "arm", ""])
def test_a_browser_that_sends_what_no_page_sends_is_closed(text: str) -> None:
    async def check() -> None:
        browsers = Browsers(channels("state", "extra"), frozenset(("extra",)))
        page = Page(browsers)
        page.say(text)
        await page.serving
        assert page.closed == 1008 and browsers.closed == {"unexpected message": 1} and not len(browsers)

    asyncio.run(check())


def test_a_browser_that_does_not_answer_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browsers_module, "ANSWER_S", 0.01)

    async def check() -> None:
        (state,) = channels("state")
        state.changed()
        browsers = Browsers((state,))
        page = Page(browsers)
        await until(lambda: page.closed)
        assert page.closed == 1001 and browsers.closed == {"no answer": 1}
        page.leave()
        await page.serving

    asyncio.run(check())
