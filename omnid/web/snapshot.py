"""The state of the robot as browsers are told it; `browsable` makes it fit to be sent."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, Final

import numpy as np

from calib import se3
from omnid.monitor.robot_state import LEVELS, RobotState, importance
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.transport.codec import Map, Pose, PoseInMap, Scan
from omnid.transport.status_names import PLACES, WHEELS, Key, NavigationReport, short_name

PATH_FRAME: Final = "odom"
FRAMES: Final = (PATH_FRAME, "map")  # Frames of a map that is drawn.
BASE_FRAME: Final = "base_link"
OLDEST_S: Final = 1.0  # age of the newest state that a page may have when it asks for a motion
LONGEST_VALUE: Final = 100  # characters
LARGEST_MAP_PX: Final = 1024  # edge of the map as it is sent; larger ones are reduced
_ROBOT_GONE: Final = "start the daemon on the robot: omnid run, or systemctl start omnid"


def server_ms() -> int:
    """Return the server's time, which states carry and requests of the stick repeat."""
    return time.monotonic_ns() // 1_000_000


def is_recent(stamp_ms: int) -> bool:
    """True for the time of a state that was sent a moment ago: its sender has seen what the robot does."""
    return 0 <= server_ms() - stamp_ms <= 1000 * OLDEST_S


def state_news(robot: str, state: RobotState, link: str, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state: tracking, pose, rates, wheels, warnings.

    link: why there is no connection to the robot; empty with one. extra: further entries.
    """
    quantiles = (0.5, 0.99)
    return {
        "robot": robot,
        "link": link,
        "alive": state.alive,
        "state": state.state,
        "fresh": state.rate_hz > 0,
        "rate_hz": state.rate_hz,
        "missed": state.missed,
        "broken": state.broken,
        "pose": None if state.pose is None else _pose(state.pose),
        "age_ms": [1e3 * state.age.p(q) for q in quantiles],
        "network_ms": [1e3 * state.network.p(q) for q in quantiles],
        "wheels": _wheels(state),
        "in_map": None if PLACES not in state.statuses else state.statuses[PLACES].message,
        "pace": state.real_time_factor,
        "warnings": _warnings(state, link),
        "server_ms": server_ms(),
        **extra,
    }


def browsable(value: Any) -> Any:
    """Return a value as browsers are sent it: text is plain, a number has 6 digits, None is what JSON lacks."""
    match value:
        case dict():
            return {key: browsable(inner) for key, inner in value.items()}
        case list():
            return [browsable(inner) for inner in value]
        case str():
            return plain(value)
        case float():
            return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def map_in_odom(in_map: PoseInMap, poses: Iterable[Pose]) -> list[float] | None:
    """Return where the map's origin lies in odom, x, y [m] and yaw [rad]; None without a pose in odom at its time."""
    pose = next((one for one in poses if one.stamp_ns == in_map.stamp_ns), None)
    if pose is None:
        return None
    T_odom_map = pose.T_odom_base @ se3.inverse(in_map.T_map_base)
    return [*T_odom_map[:2, -1].tolist(), float(se3.yaw(T_odom_map))]


def parts_news(state: RobotState) -> list[dict[str, Any]]:
    """Return all status entries, the worst first, stages last."""
    return [
        {
            "name": short_name(part.name),
            "level": part.level % len(LEVELS),
            "message": part.message,
            "values": [
                [key[:LONGEST_VALUE], value[:LONGEST_VALUE]] for key, value in islice(part.values.items(), MOST_ENTRIES)
            ],
        }
        for part in sorted(state.statuses.values(), key=importance)
    ]


def map_cells(grid: Map) -> tuple[dict[str, Any], bytes]:
    """Return a map's size and place, and its cells: 0 unknown, 1 free, 2 occupied, row by row from low to high y.

    The cells are deflated. The size is 0 unless the grid is in odom, which is the frame of the path, or in map, whose
    place in odom is part of the state.
    """
    if not all(map(math.isfinite, (grid.cell_m, *grid.corner))) or not grid.cells.size or grid.frame not in FRAMES:
        return {"width": 0, "frame": grid.frame}, b""
    step = -(-max(grid.cells.shape) // LARGEST_MAP_PX)
    cells = _reduced(np.where(grid.cells > 50, 2, np.where(grid.cells >= 0, 1, 0)).astype(np.uint8), step)
    header = {
        "width": cells.shape[1],
        "height": cells.shape[0],
        "frame": grid.frame,
        "cell_m": step * grid.cell_m,
        "x_m": grid.corner[0],
        "y_m": grid.corner[1],
        "known": None,
    }
    # Left, low, right and high of what is known, m: a grid is as wide as views may reach.
    rows, columns = np.nonzero(cells)
    if rows.size:
        edges = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        header["known"] = (np.tile(grid.corner, 2) + step * grid.cell_m * edges).tolist()
    return header, zlib.compress(cells.tobytes(), 1)


def scan_news(scan: Scan, poses: Iterable[Pose]) -> dict[str, Any]:
    """Return the nearest obstacles around the robot, in odom, and the nearest of all.

    poses: the newest ones. The scan is drawn at the pose that is nearest in time. There are no points where there is no
    pose, or where the scan is not in the robot's own frame.
    """
    place = min(poses, key=lambda pose: abs(pose.stamp_ns - scan.stamp_ns), default=None)
    seen = (scan.ranges_m > 0) & (scan.ranges_m <= scan.max_range_m)
    ranges_m, azimuths_rad = scan.ranges_m[seen].astype(float), scan.azimuths_rad[seen].astype(float)
    if place is None or scan.frame != BASE_FRAME or not ranges_m.size:
        return {"points": [], "nearest": None}
    nearest, angles = int(ranges_m.argmin()), azimuths_rad + place.yaw_rad
    points = np.column_stack([place.x_m + ranges_m * np.cos(angles), place.y_m + ranges_m * np.sin(angles)])
    turn_deg = math.degrees(math.remainder(float(azimuths_rad[nearest]), 2 * math.pi))
    return {"points": points.tolist(), "nearest": [float(ranges_m[nearest]), turn_deg]}


def navigation_news(report: NavigationReport) -> dict[str, Any]:
    """Return what is driven or taught, and what became of the newest request."""
    names = ("state", "reason", "task", "left_m", "teaching", "taught_m", "refusal")
    return {name: getattr(report, name) for name in names}


def _reduced(cells: np.ndarray[Any, np.dtype[np.uint8]], step: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return the highest value in each square of step x step cells."""
    if step == 1:
        return cells
    height, width = (-(-edge // step) for edge in cells.shape)
    padded = np.zeros((height * step, width * step), np.uint8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    reduced: np.ndarray[Any, np.dtype[np.uint8]] = padded.reshape(height, step, width, step).max(axis=(1, 3))
    return reduced


def _pose(pose: Pose) -> dict[str, Any]:
    sigma = np.sqrt(np.maximum(0.0, pose.covariance.diagonal()))
    found = pose.attachment
    return {
        "x_m": pose.x_m,
        "y_m": pose.y_m,
        "z_m": pose.z_m,
        "yaw_rad": pose.yaw_rad,
        "speed_mps": float(pose.velocity[0]),
        "sigma_mm": 1e3 * float(sigma[:3].max()),
        "sigma_deg": math.degrees(sigma[3:].max()),
        "inliers": found.inliers,
        "tracked": found.tracked,
        "resets": found.resets,
    }


def _wheels(state: RobotState) -> dict[str, Any] | None:
    """Return the wheels' entry; None where the robot has reported none, or its daemon has ended."""
    status = state.statuses.get(WHEELS)
    if status is None or state.alive is False:
        return None
    return {
        "armed": status.values.get(Key.ARMED) == "1",
        "message": status.message,
        "level": status.level % len(LEVELS),
        "source": status.values.get(Key.SOURCE, ""),
    }


def _warnings(state: RobotState, link: str) -> list[dict[str, Any]]:
    """Return what is wrong, the worst first, each with its remedy."""
    found = []
    if link:
        found.append((2, "connection", link, "is the robot on, and on this network? check --connect"))
    elif state.alive is False:
        found.append((2, "robot", "its daemon has ended or cannot be reached", _ROBOT_GONE))
    for part in sorted(state.statuses.values(), key=importance):
        if level := part.level % len(LEVELS):
            found.append((level, short_name(part.name), part.message, part.values.get(Key.REMEDY, "")))
    return [dict(zip(("level", "name", "message", "remedy"), row, strict=True)) for row in found]
