"""Messages for a page about the robot: numbers by hand, and the order of parts and warnings."""

from __future__ import annotations

import json
import math
import zlib
from typing import Any

import numpy as np
import pytest

from calib import se3
from omnid.monitor.robot_state import RobotState
from omnid.transport.decode import Diagnostics, Map, NavigationReport, Pose, PoseAttachment, PoseInMap
from omnid.transport.records import DiagnosticStatus
from omnid.transport.scan_codec import Scan
from omnid.transport.status_names import ODOMETRY, PLACES, WHEELS, Key
from omnid.web.snapshot import (
    LARGEST_MAP_PX,
    LONGEST_VALUE,
    MOST_SECTORS,
    MOST_VALUES,
    MOST_WARNINGS,
    finite,
    map_in_odom,
    map_message,
    navigation_message,
    parts_message,
    scan_message,
    state_message,
)


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


def test_ages_are_shown_in_milliseconds() -> None:
    robot = state()
    for _ in range(100):
        robot.age.add(0.08)
    assert shown(robot)["age_ms"] == pytest.approx([80.0, 80.0], rel=0.2)


def test_a_level_beyond_those_of_ros_is_taken_for_one_of_them() -> None:
    robot = state(DiagnosticStatus(WHEELS, 6, "a fault", {}), DiagnosticStatus(ODOMETRY, 4, "well", {}))
    assert shown(robot)["wheels"]["level"] == 2
    assert [(one["level"], one["message"]) for one in shown(robot)["warnings"]] == [(2, "a fault")]


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


def test_a_fine_scan_is_thinned_and_keeps_the_nearest_obstacle() -> None:
    count = 2 * MOST_SECTORS + 1
    ranges = np.full(count, 3.0)
    ranges[7] = 0.4
    azimuths = np.linspace(-math.pi, math.pi, count)
    found = json.loads(scan_message(scan(ranges.tolist(), azimuths.tolist()), [pose(100, 0.0, 0.0, 0.0)]))
    assert MOST_SECTORS // 2 < len(found["points"]) <= MOST_SECTORS + 1
    away_m = np.hypot(*np.array(found["points"]).T)
    assert away_m.min() == pytest.approx(0.4, abs=1e-3) and found["nearest"][0] == pytest.approx(0.4)


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


def test_numbers_have_six_digits_or_are_missing() -> None:
    assert finite(1.23456789) == 1.23457 and finite(math.nan) is None and finite(-math.inf) is None
