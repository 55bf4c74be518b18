"""From the robot's messages to what browsers and Prometheus are sent, without a program."""

from __future__ import annotations

import asyncio
import math
import time
from typing import Any

import numpy as np
import pytest
from prometheus_client import parser

from calib import se3
from drivers.frame import Frame
from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.transport import codec
from omnid.transport.bus import BusConfig
from omnid.transport.codec import Diagnostics, DiagnosticStatus, Pose, PoseAttachment, Scan, scan_cdr
from omnid.transport.sensor_codec import image_cdr
from omnid.transport.status_names import NAVIGATION, ODOMETRY, PLACES, WHEELS, Key
from omnid.web.feed import MOST_POINTS, LivePath, RobotFeed, scan_news, state_news
from omnid.web.metrics import metrics
from tests.omnid.transport.bus_fixtures import odometry

# The path.


def test_browsers_that_come_at_any_time_show_the_same_path() -> None:
    path, version = LivePath(), 1
    shown: dict[int, list[list[float]]] = {1: [], 7: [], 100: []}
    seen = dict.fromkeys(shown, 0)

    def follow(every: int) -> None:
        """Apply the next news as the page does."""
        news = path.news(seen[every])
        if news is not None:
            assert news["from"] <= len(shown[every])
            shown[every][news["from"] :] = news["points"]
        seen[every] = version

    for step in range(20_000):
        version = step + 1
        path.add(0.01 * step, math.sin(0.01 * step), version, gap=step in (500, 15_000))
        if step == 9000:
            path.clear(version)
        for every in shown:
            if step % every == 0:
                follow(every)
    for every in shown:
        follow(every)
    assert shown[1] == shown[7] == shown[100] and 1000 < len(shown[1]) <= MOST_POINTS
    assert sum(len(point) > 2 for point in shown[1]) == 1 and shown[1][0][0] == pytest.approx(90.01, abs=0.1)


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
    return state_news("rover", robot, link, {"more": 3})


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


def scan(ranges: list[float], azimuths: list[float], frame: str = "base_link", stamp_ns: int = 100) -> Scan:
    return Scan(stamp_ns, frame, np.array(azimuths), np.array(ranges), np.array([]), 8.0)


def test_obstacles_are_drawn_from_the_pose_nearest_in_time() -> None:
    poses = [pose(10, 9.0, 9.0, 0.0), pose(90, 1.0, 2.0, math.pi / 2), pose(300, 5.0, 5.0, 0.0)]
    ranges = [2.0, math.nan, math.inf, 0.0, -1.0, 1.5, 2e4]
    azimuths = [0.0, 0.1, 0.2, 0.3, 0.4, 3 * math.pi / 2, 0.5]
    found = scan_news(scan(ranges, azimuths), poses)
    np.testing.assert_allclose(found["points"], [(1.0, 4.0), (2.5, 2.0)], atol=1e-3)
    assert found["nearest"] == pytest.approx([1.5, -90.0])
    nothing = {"points": [], "nearest": None}
    assert scan_news(scan(ranges, azimuths, "map"), poses) == nothing
    assert scan_news(scan(ranges, azimuths), []) == nothing
    assert scan_news(scan([math.inf], [0.0]), poses) == nothing


# The feed.


STATUS = codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 0, "armed", {Key.ARMED: "1"})])
MAP = codec.grid_cdr(10**18, "odom", np.full((4, 3), 100, np.int8), 0.1, (-1.0, -2.0))
SCAN = scan_cdr(10**9, "base_link", np.ones(360, np.float32), np.ones(360, np.float32), (0.1, 6.0))


def panorama(data: bytes) -> bytes:
    return bytes(image_cdr(Frame(1, 10**9, "lower", "jpeg", np.frombuffer(data, np.uint8)), 10**9)[1])


def add_pose(feed: RobotFeed, seq: int, run: str = "a") -> None:
    """Put a pose at 0.25 m times seq into the inbox."""
    feed.state.put("odom", odometry(seq), PoseAttachment(seq, "tracking", 0, 50, 60, time.time_ns(), run).to_bytes())


def test_a_robot_that_has_started_again_is_shown_without_what_belongs_to_its_odom_before() -> None:
    """The pages are sent news without a map, obstacles, navigation and panorama, in place of the old ones."""
    feed = RobotFeed(BusConfig())
    navigation = DiagnosticStatus(NAVIGATION, 0, "", {str(Key.STATE): "driving", str(Key.TASK): "goal"})
    large = {
        "map": MAP,
        "scan": SCAN,
        "panorama": panorama(b"\xff\xd8 bytes"),
        "navigation": codec.diagnostics_cdr(10**18, [navigation]),
    }
    for run in "ab":  # with nothing to forget there is nothing to send
        add_pose(feed, 0, run)
    feed.process_inbox()
    assert not feed.news(0).keys() & large.keys()
    add_pose(feed, 4, "b")
    feed.state.put("map_pose", codec.map_pose_cdr(10**9 + 4, np.eye(4), np.eye(6)), b"")
    feed.process_inbox()

    async def take() -> None:
        for topic, payload in large.items():
            await feed.take_large(ReceivedMessage(0, topic, payload, b"", 0))

    asyncio.run(take())
    news = feed.news(0)
    assert news["state"]["map_in_odom"] is not None and news["map"]["width"] == 3 and news["panorama"]
    assert news["scan"]["points"] and news["navigation"]["task"] == "goal" and len(news["path"]["points"]) == 2
    add_pose(feed, 5)
    feed.process_inbox()
    news = feed.news(0)
    assert news["state"]["map_in_odom"] is None and news["map"] == {"width": 0, "frame": "odom"}
    assert news["panorama"] == 0 and news["scan"] == {"points": [], "nearest": None}
    report = news["navigation"]
    assert (report["state"], report["task"], report["left_m"]) == ("", "", None)


def test_numbers_of_the_status_with_labels_that_cannot_break_out() -> None:
    state = RobotState()
    state.alive = True
    values = {"rate_hz": "29.5", "mode": "640x480", "bad": "nan", 'a"} 1\nomnid_up 0': "7"}
    state.add_diagnostics(Diagnostics(1, (DiagnosticStatus("omnid: odometry", 1, "x", values),)))
    families = parser.text_string_to_metric_families(metrics(state).decode())
    found = {(one.name, *one.labels.values()): one.value for family in families for one in family.samples}
    assert found["omnid_up",] == 1 and found["omnid_status_level", "odometry"] == 1
    assert [value for labels, value in found.items() if labels[0] == "omnid_status_value"] == [29.5, 7.0]
