"""The robot's messages from the bus, as the news that browsers ask for.

zenoh calls in its own threads: they only put a message into a bounded inbox, or replace the newest one, and wake the
event loop. Nothing that a browser does can reach that far. A browser asks for what has changed since the news that it
has shown, and is answered as soon as there is something: one that is slow skips what a newer message has replaced.
"""

from __future__ import annotations

import asyncio
import json
import math
import secrets
import time
from bisect import bisect
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from omnid.client import Map, NavigationReport, Robot, Scan, Unreachable
from omnid.core.mapping.thinned_path import ThinnedPath, Vertex
from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.transport.bus_config import BusConfig
from omnid.transport.codec import Diagnostics, Panorama, PlanarPath, Pose, PoseInMap
from omnid.transport.topics import MAP_POSE, PANORAMA, SCAN
from omnid.web import snapshot

PERIOD_S: Final = 0.03  # least time between two answers to a browser
QUIET_S: Final = 0.5  # The state is sent after this time even without a message of the robot; between two connections
WANTED_S: Final = 2.0  # The panorama is received for this time after a browser has asked for it.
MOST_POINTS: Final = 4000  # Most points of the path.
_FINEST_M: Final = 0.02  # Points of the path are at least this far apart, so that a robot at rest adds none.
NAVIGATION: Final = "navigation"
LARGEST: Final = 1 << 26  # bytes of a message: a map of 8,000 x 8,000 cells
_NEWEST_ONLY: Final = (NAVIGATION, SCAN, "map", PANORAMA)
_KEPT: Final = ("path", "status", "map")  # Topics whose message from before the connection is asked for.


class LivePath:
    """The path of the robot; a browser is sent the points that it has not seen."""

    def __init__(self) -> None:
        self._since = 0  # version since which points are only added
        self._path = ThinnedPath(MOST_POINTS, _FINEST_M)

    def add(self, x_m: float, y_m: float, version: int, *, gap: bool = False) -> None:
        """Add a position, m. version: of the news that it comes with. gap: the robot was put elsewhere."""
        path, times_thinned = self._path, self._path.thinned
        path.add(Vertex(x_m, y_m, gap and bool(path.vertices), version))
        if path.thinned != times_thinned:
            self._since = version  # all are sent again

    def clear(self, version: int) -> None:
        """Begin a new path: the robot has started again."""
        self._path.clear()
        self._since = version

    def news(self, seen: int) -> dict[str, Any] | None:
        """Return the points [x, y] added since that version, or all with `from` 0; after a gap [x, y, 1]."""
        vertices = self._path.vertices
        begin = bisect(vertices, seen, key=lambda point: point.version) if seen >= self._since else 0
        if seen >= self._since and begin == len(vertices):
            return None
        points = [[point.x_m, point.y_m, *([1] if point.after_gap else [])] for point in vertices[begin:]]
        return {"from": begin, "points": points}


class RobotFeed:
    """Follows one robot, and answers the browsers."""

    def __init__(self, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self.bus = bus
        self.state, self.path = RobotState(), LivePath()
        self.robot: Robot | None = None
        self.link = "not connected yet"  # why there is no connection; empty with one
        # Of the news: it grows by one each time, from a number of this start, so that pages which were open while this
        # program started again have seen none of them.
        self.version = self._start = secrets.randbits(48)  # of 15 digits at most
        self._news: dict[str, tuple[int, Any]] = {}  # newest content of each kind, and the version that it came with
        self._images: dict[str, bytes] = {}  # cells of the map, and the panorama
        self._changed = asyncio.Condition()
        self._wanted_until_s = -math.inf  # the panorama
        self._map_in_odom: list[float] | None = None
        self._large: dict[str, ReceivedMessage] = {}  # newest map, panorama ... that are not processed yet
        self._wake, self._large_wake = asyncio.Event(), asyncio.Event()

    def news(self, seen: int) -> dict[str, Any]:
        """Return all that has changed since a version, and the state."""
        seen = seen if self._start <= seen <= self.version else 0
        extra = {
            "dropped": self.state.dropped,
            "panorama_comes": "panorama" in self._news,
            "map_in_odom": self._map_in_odom,
        }
        found = {"seen": self.version, "state": snapshot.state_news(self.bus.robot, self.state, self.link, extra)}
        if (path := self.path.news(seen)) is not None:
            found["path"] = path
        found |= {kind: content for kind, (version, content) in self._news.items() if version > seen}
        return dict(snapshot.browsable(found))

    async def live(self, request: Request) -> Response:
        """Answer a browser as soon as there are news: `seen` is the version of its last, `panorama` 1 asks for it."""
        seen = request.query_params.get("seen", "")
        if not (seen.isascii() and seen.isdigit() and len(seen) < 16):
            return PlainTextResponse(
                "omnid web: the page names the version of the news that it has seen\n", HTTPStatus.BAD_REQUEST
            )
        if request.query_params.get("panorama") == "1":
            self._wanted_until_s = time.monotonic() + WANTED_S
        if int(seen) == self.version:
            async with self._changed:
                await self._changed.wait()
        text = json.dumps(self.news(int(seen)), separators=(",", ":"), allow_nan=False)
        return Response(text, media_type="application/json")

    async def image(self, request: Request) -> Response:
        """Return the cells of the map, a byte each as `map_cells` makes them, or the newest panorama."""
        kind = request.path_params["kind"]
        if kind not in self._images:
            return PlainTextResponse("omnid web: there is none\n", HTTPStatus.NOT_FOUND)
        if kind == "map":
            headers = {"content-encoding": "deflate"}
            return Response(self._images[kind], headers=headers, media_type="application/octet-stream")
        return Response(self._images[kind], media_type="image/jpeg")

    async def run(self) -> None:
        """Connect to the robot as soon as it can be reached, and follow it until this task is cancelled."""
        try:
            await asyncio.gather(self._connect(), self._give_news(), self._process_large())
        finally:
            if self.robot is not None:
                self.robot.close()

    async def _give_news(self) -> None:
        """Process what has come, and let the browsers that wait have it."""
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(QUIET_S):
                    await self._wake.wait()
            self._wake.clear()
            self.process_inbox()
            async with self._changed:
                self.version += 1
                self._changed.notify_all()
            await asyncio.sleep(PERIOD_S)

    async def _connect(self) -> None:
        """Open the connection, take what was published before it, then receive the panorama while browsers show it."""
        loop = asyncio.get_running_loop()

        def receive(topic: str, payload: bytes, attachment: bytes) -> None:
            """Take a message, in a thread of zenoh."""
            if len(payload) > LARGEST:
                self.state.broken += 1
                return
            if topic in _NEWEST_ONLY:  # in place of one that was not processed yet
                self._large[topic] = ReceivedMessage(0, topic, payload, attachment, 0)
            else:
                self.state.put(topic, payload, attachment)
            wake = self._large_wake if topic in self._large else self._wake
            if not wake.is_set():
                with suppress(RuntimeError):  # the event loop has ended
                    loop.call_soon_threadsafe(wake.set)

        while self.robot is None:
            try:
                self.robot = await asyncio.to_thread(Robot, settings=self.bus)
            except Unreachable as error:
                self.link = str(error)
                await asyncio.sleep(QUIET_S)
        for topic in ("path", "odom", MAP_POSE, "status", "map", SCAN, NAVIGATION):
            end = await asyncio.to_thread(self.robot.on_message, receive, topic, kept=topic in _KEPT)
            if topic == "path":  # which grows by the poses from here on
                await asyncio.to_thread(end)
        self.link, end_panorama = "", None
        self.robot.on_alive(self.state.set_alive)
        while True:
            await asyncio.sleep(0.1 * WANTED_S)
            is_wanted = time.monotonic() < self._wanted_until_s
            if is_wanted and end_panorama is None:
                end_panorama = self.robot.on_message(receive, PANORAMA)
            elif not is_wanted and end_panorama is not None:
                await asyncio.to_thread(end_panorama)
                end_panorama = None

    def _set(self, kind: str, content: Any) -> None:
        """Have a content sent with the next news."""
        self._news[kind] = self.version + 1, content

    def process_inbox(self) -> None:
        """Process the poses and statuses that have come; forget the statuses of a daemon that has ended."""
        before = self.state.pose
        while (received := self.state.next(0.0)) is not None:
            match received[1]:
                case Pose() as pose:
                    self._add_to_path(pose, before)
                    before = pose
                case PoseInMap() as in_map:
                    self._map_in_odom = snapshot.map_in_odom(in_map, self.state.recent) or self._map_in_odom
                case Diagnostics():
                    self._set("parts", snapshot.parts_news(self.state))
                case PlanarPath(frame=frame, xy=xy) if frame == snapshot.PATH_FRAME:
                    for x_m, y_m in xy.tolist():
                        self.path.add(x_m, y_m, self.version + 1)
        if self.state.forget_ended():
            self._set("parts", snapshot.parts_news(self.state))

    def _add_to_path(self, pose: Pose, before: Pose | None) -> None:
        """Add a pose; another run has another odom."""
        if before is not None and pose.attachment.run != before.attachment.run:
            self.path.clear(self.version + 1)
            self._map_in_odom = None
            self._images.clear()
            nothing = {
                "map": {"frame": snapshot.PATH_FRAME, "width": 0},
                SCAN: {"points": [], "nearest": None},
                NAVIGATION: snapshot.navigation_news(NavigationReport()),
                PANORAMA: 0,
            }
            for kind in nothing.keys() & self._news.keys():
                self._set(kind, nothing[kind])
        gap = before is not None and pose.attachment.resets != before.attachment.resets
        self.path.add(pose.x_m, pose.y_m, self.version + 1, gap=gap)

    async def _process_large(self) -> None:
        """Decode and encode maps and panoramas in a thread; they take longer than a pose may wait."""
        while True:
            await self._large_wake.wait()
            self._large_wake.clear()
            for topic in _NEWEST_ONLY:
                if (message := self._large.pop(topic, None)) is not None:
                    await self.take_large(message)
            self._wake.set()

    async def take_large(self, message: ReceivedMessage) -> None:
        """Take a scan, a report of the navigation, a map or a panorama."""
        match await asyncio.to_thread(self.state.process, message):
            case Scan() as scan:
                self._set(SCAN, snapshot.scan_news(scan, self.state.recent))
            case NavigationReport() as report:
                self._set(NAVIGATION, snapshot.navigation_news(report))
            case Map() as grid:
                header, self._images["map"] = await asyncio.to_thread(snapshot.map_cells, grid)
                self._set("map", {**header, "version": self.version + 1})
            case Panorama(data=data):
                self._images[PANORAMA] = data
                self._set(PANORAMA, self.version + 1)
