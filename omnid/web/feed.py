"""The state of the robot for browsers, as changes since the version that each of them has.

zenoh calls in its own threads: they only put a message into a bounded inbox, or replace the newest one, and wake the
event loop. Nothing that a browser does can reach that far. A browser asks for what has changed since the news that it
has shown, and is answered as soon as there is something: one that is slow skips what a newer message has replaced.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
import zlib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from http import HTTPStatus
from typing import Any, Final

import msgspec
import numpy as np
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from calib import se3
from omnid.client import Map, NavigationReport, Robot, Scan, Unreachable
from omnid.monitor.robot_state import LEVELS, RobotState, importance
from omnid.monitor.teleop import PERIOD_S
from omnid.plain_text import plain
from omnid.transport.codec import Diagnostics, Panorama, PlanarPath, Pose, PoseInMap
from omnid.transport.session import BusConfig
from omnid.transport.status_names import CALIBRATION, MAP_FILE, PLACES, TIMEOUT_S, WHEELS, Key, short_name
from omnid.transport.topics import MAP_POSE, PANORAMA, SCAN

QUIET_S: Final = 0.5  # The state is sent after this time even without a message of the robot; between two connections
OLDEST_S: Final = TIMEOUT_S  # age of the newest state that a page may have when it asks for a motion
NAVIGATION: Final = "navigation"
FRAMES: Final = ("odom", "map")  # Frames of a map that is drawn.
# Topics whose newest message alone counts.
_NEWEST_ONLY: Final = (NAVIGATION, SCAN, "map", "path", PANORAMA)


class RobotFeed:
    """Follows one robot, and answers the browsers."""

    def __init__(self, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self.bus = bus
        self.state, self._inbox_thread = RobotState(_NEWEST_ONLY), ThreadPoolExecutor(1)
        self.robot: Robot | None = None
        self.link = "not connected yet"  # why there is no connection; empty with one
        # The version of the news begins as Unix time in ms and grows by one with each news, which is slower than that
        # time: a page that was open before this program started has a smaller version.
        self.version = time.time_ns() // 1_000_000
        self._news: dict[str, tuple[int, Any]] = {}  # newest content of each kind, and the version that it came with
        self._images: dict[str, Response] = {}  # cells of the map, and the panorama
        self._wanted_until_s = -math.inf  # until then a browser shows the panorama
        self._map_in_odom: list[float] | None = None

    def news(self, seen: int) -> dict[str, Any]:
        """Return all that has changed since a version, and the state."""
        if seen > self.version:  # of a computer's clock that was set back
            seen = 0
        state = state_news(self.bus.robot, self.state, self.link)
        state |= {"panorama_comes": PANORAMA in self._news, "map_in_odom": self._map_in_odom}
        found = {"seen": self.version, "state": state}
        return found | {kind: content for kind, (version, content) in self._news.copy().items() if version > seen}

    async def live(self, request: Request) -> Response:
        """Answer a browser as soon as there are news: `seen` is the version of its last, `panorama` 1 asks for it."""
        seen = request.query_params.get("seen", "")
        if not re.fullmatch(r"[0-9]{1,15}", seen):
            return _text("the page names the version of the news that it has seen", HTTPStatus.BAD_REQUEST)
        if request.query_params.get("panorama") == "1":
            self._wanted_until_s = time.monotonic() + 4 * QUIET_S
        while int(seen) == self.version:
            await asyncio.sleep(PERIOD_S)
        return Response(msgspec.json.encode(self.news(int(seen))), media_type="application/json")  # NaN becomes null

    async def image(self, request: Request) -> Response:
        """Return the cells of the map, a byte each as `map_cells` makes them, or the newest panorama."""
        return self._images.get(request.path_params["kind"]) or _text("there is none", HTTPStatus.NOT_FOUND)

    async def run(self) -> None:
        """Connect to the robot as soon as it can be reached, and follow it until this task is cancelled."""
        try:
            await asyncio.gather(self._connect(), self._give_news())
        finally:
            if self.robot is not None:
                self.robot.close()

    async def _give_news(self) -> None:
        """Process what has come, and let the browsers that wait have it."""
        given_s = -math.inf
        while True:
            await asyncio.sleep(PERIOD_S)
            if self.state.is_waiting or time.monotonic() > given_s + QUIET_S:
                # Maps and images take time; the other threads may all wait for answers of the robot.
                await asyncio.get_running_loop().run_in_executor(self._inbox_thread, self.process_inbox)
                self.version, given_s = self.version + 1, time.monotonic()

    async def _connect(self) -> None:
        """Open the connection, take what was published before it, then receive the panorama while browsers show it."""
        receive = self.state.put
        while self.robot is None:
            try:
                self.robot = await asyncio.to_thread(Robot, settings=self.bus)
            except Unreachable as error:
                self.link = str(error)
                await asyncio.sleep(QUIET_S)
        for topic in ("odom", MAP_POSE, "status", "map", "path", SCAN, NAVIGATION):
            await asyncio.to_thread(self.robot.on_message, receive, topic, kept=topic in ("status", "map", "path"))
        self.link = ""
        self.robot.on_alive(self.state.set_alive)
        end_panorama: Callable[[], None] | None = None
        while True:
            await asyncio.sleep(QUIET_S / 2)
            is_wanted = time.monotonic() < self._wanted_until_s
            if is_wanted and end_panorama is None:
                end_panorama = self.robot.on_message(receive, PANORAMA)
            elif not is_wanted and end_panorama is not None:
                await asyncio.to_thread(end_panorama)
                end_panorama = None

    def _set(self, kind: str, content: Any) -> None:
        """Send a content with the next news."""
        self._news[kind] = self.version + 1, content

    def process_inbox(self) -> None:
        """Process what has come; forget the statuses of a daemon that has ended."""
        before, has_news = self.state.pose, False
        while self.state.is_waiting:
            match self.state.next(0.0):
                case Pose() as pose:
                    # Another run has another odom, for which the pages load again.
                    if before is not None and pose.attachment.run != before.attachment.run:
                        self._map_in_odom = None
                        self._images.clear()
                        self._news.clear()
                    before = pose
                case PoseInMap() as in_map:
                    self._map_in_odom = map_in_odom(in_map, self.state.recent) or self._map_in_odom
                case Diagnostics():
                    has_news = True
                case Scan() as scan:
                    self._set(SCAN, scan_news(scan, list(self.state.recent)))
                case NavigationReport() as report:
                    self._set(NAVIGATION, asdict(report))
                case PlanarPath(frame=frame, xy=xy) if frame == "odom":
                    self._set("path", xy.round(3).tolist())
                case Map() as grid:
                    header, cells = map_cells(grid)
                    encoding = {"content-encoding": "deflate"}
                    self._images["map"] = Response(cells, headers=encoding, media_type="application/octet-stream")
                    self._set("map", {**header, "version": self.version + 1})
                case Panorama(data=data):
                    self._images[PANORAMA] = Response(data, media_type="image/jpeg")
                    self._set(PANORAMA, self.version + 1)
        if has_news or not self.state.statuses:
            self._set("parts", parts_news(self.state))


def _text(text: str, status: HTTPStatus) -> Response:
    return PlainTextResponse(f"omnid web: {text}\n", status)


def server_ms() -> int:
    """Return the server's time, which states carry and requests of the stick repeat."""
    return time.monotonic_ns() // 1_000_000


def is_recent(stamp_ms: int) -> bool:
    """True for the time of a state that was sent a moment ago: its sender has seen what the robot does."""
    return 0 <= server_ms() - stamp_ms <= 1000 * OLDEST_S


def state_news(robot: str, state: RobotState, link: str) -> dict[str, Any]:
    """Return tracking, pose, rates, wheels, warnings. link: why there is no connection to the robot; empty with one."""
    return {
        "robot": robot,
        "link": link,
        **{name: getattr(state, name) for name in ("alive", "state", "rate_hz", "missed", "broken")},
        "fresh": state.rate_hz > 0,
        "run": None if state.pose is None else state.pose.attachment.run,
        "pose": None if state.pose is None else _pose(state.pose),
        "wheels": _wheels(state),
        "in_map": None if PLACES not in state.statuses else state.statuses[PLACES].message,
        "pace": state.real_time_factor,
        "warnings": _warnings(state, link),
        "server_ms": server_ms(),
    }


def map_in_odom(in_map: PoseInMap, poses: Iterable[Pose]) -> list[float] | None:
    """Return where the map's origin lies in odom, x, y [m] and yaw [rad]; None without a pose in odom at its time."""
    pose = next((one for one in poses if one.stamp_ns == in_map.stamp_ns), None)
    if pose is None:
        return None
    T_odom_map = pose.T_odom_base @ se3.inverse(in_map.T_map_base)
    return [*T_odom_map[:2, -1].tolist(), float(se3.yaw(T_odom_map))]


def parts_news(state: RobotState) -> list[dict[str, Any]]:
    """Return the status entries of which the page shows the values."""
    found = [part for name in (CALIBRATION, MAP_FILE) if (part := state.statuses.get(name)) is not None]
    return [
        {"name": short_name(part.name), "level": part.level, "message": part.message, "values": [*part.values.items()]}
        for part in found
    ]


def map_cells(grid: Map) -> tuple[dict[str, Any], bytes]:
    """Return a map's size and place, and its cells: 0 unknown, 1 free, 2 occupied, row by row from low to high y.

    The cells are deflated. The size is 0 unless the grid is in odom, which is the frame of the path, or in map, whose
    place in odom is part of the state.
    """
    if not all(map(math.isfinite, (grid.cell_m, *grid.corner))) or not grid.cells.size or grid.frame not in FRAMES:
        return {"width": 0, "frame": plain(grid.frame)}, b""
    cells = np.where(grid.cells > 50, 2, np.where(grid.cells >= 0, 1, 0)).astype(np.uint8)
    header = {
        "width": cells.shape[1],
        "height": cells.shape[0],
        "frame": grid.frame,
        "cell_m": grid.cell_m,
        "x_m": grid.corner[0],
        "y_m": grid.corner[1],
        "known": None,
    }
    # Left, low, right and high of what is known, m: a grid is as wide as views may reach.
    rows, columns = np.nonzero(cells)
    if rows.size:
        edges = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        header["known"] = (np.tile(grid.corner, 2) + grid.cell_m * edges).tolist()
    return header, zlib.compress(cells.tobytes(), 1)


def scan_news(scan: Scan, poses: Iterable[Pose]) -> dict[str, Any]:
    """Return the nearest obstacles around the robot, in odom, and the nearest of all.

    poses: the newest ones. The scan is drawn at the pose that is nearest in time. There are no points where there is no
    pose, or where the scan is not in the robot's own frame.
    """
    place = min(poses, key=lambda pose: abs(pose.stamp_ns - scan.stamp_ns), default=None)
    seen = (scan.ranges_m > 0) & (scan.ranges_m <= scan.max_range_m)
    ranges_m, azimuths_rad = scan.ranges_m[seen].astype(float), scan.azimuths_rad[seen].astype(float)
    if place is None or scan.frame != "base_link" or not ranges_m.size:
        return {"points": [], "nearest": None}
    nearest, angles = int(ranges_m.argmin()), azimuths_rad + place.yaw_rad
    points = np.column_stack([place.x_m + ranges_m * np.cos(angles), place.y_m + ranges_m * np.sin(angles)])
    turn_deg = math.degrees(math.remainder(float(azimuths_rad[nearest]), 2 * math.pi))
    return {"points": points.round(3).tolist(), "nearest": [float(ranges_m[nearest]), turn_deg]}


def _pose(pose: Pose) -> dict[str, Any]:
    sigma = np.sqrt(np.maximum(0.0, pose.covariance.diagonal()))
    return {
        **{name: getattr(pose, name) for name in ("x_m", "y_m", "z_m", "yaw_rad")},
        **{name: getattr(pose.attachment, name) for name in ("inliers", "tracked", "resets")},
        "speed_mps": float(pose.velocity[0]),
        "sigma_mm": 1e3 * float(sigma[:3].max()),
        "sigma_deg": math.degrees(sigma[3:].max()),
    }


def _wheels(state: RobotState) -> dict[str, Any] | None:
    """Return the wheels' entry; None where the robot has reported none, or its daemon has ended."""
    status = state.statuses.get(WHEELS)
    if status is None or state.alive is False:
        return None
    return {
        "armed": status.values.get(Key.ARMED) == "1",
        "message": status.message,
        "source": status.values.get(Key.SOURCE, ""),
    }


def _warnings(state: RobotState, link: str) -> list[dict[str, Any]]:
    """Return what is wrong, the worst first, each with its remedy."""
    found = []
    remedy = "start the daemon on the robot: omnid run, or systemctl start omnid"
    if link:
        found.append((2, "connection", link, "is the robot on, and on this network? check --connect"))
    elif state.alive is False:
        found.append((2, "robot", "its daemon has ended or cannot be reached", remedy))
    for part in sorted(state.statuses.values(), key=importance):
        if level := part.level % len(LEVELS):
            found.append((level, short_name(part.name), part.message, part.values.get(Key.REMEDY, "")))
    return [dict(zip(("level", "name", "message", "remedy"), row, strict=True)) for row in found]
