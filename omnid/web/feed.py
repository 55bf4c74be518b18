"""The robot's messages from the bus to the channels of the browsers.

zenoh calls in its own threads: they only put a message into a bounded inbox, or replace the newest one, and wake the
event loop. Nothing that a browser does can reach that far.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from drivers.errors import FrameDecodeError
from drivers.logs.ros_messages import COMPRESSED_IMAGE, parse_image
from omnid.client import Diagnostics, Map, NavigationReport, Robot, Unreachable
from omnid.errors import OmnidError
from omnid.monitor.robot_state import Inbox, RobotState
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import Pose, decode_map, decode_map_pose, decode_navigation, decode_scan
from omnid.transport.topics import MAP_POSE, PANORAMA, SCAN
from omnid.web.browsers import Browsers
from omnid.web.channels import LivePath, Newest, Stored, with_header
from omnid.web.snapshot import (
    MOST_CELLS,
    PATH_FRAME,
    map_in_odom,
    map_message,
    navigation_message,
    no_map_message,
    no_scan_message,
    parts_message,
    scan_message,
    server_ms,
    state_message,
)

PERIOD_S: Final = 0.03  # least time between two messages of the state
QUIET_S: Final = 0.5  # The state is sent after this time even without a message of the robot.
RETRY_S: Final = 0.5
REQUEST_S: Final = 0.2  # Period with which requests of browsers for channels are handled.
NAVIGATION: Final = "navigation"
PANORAMA_S: Final = 0.4  # least time between two panoramas: what a robot publishes more often is left out
MOST_POSES: Final = 100  # Most poses that are kept: a scan arrives later than the pose of its images.
_LARGEST: Final = {
    "odom": 1 << 16,
    MAP_POSE: 1 << 16,
    "status": 1 << 20,
    SCAN: 1 << 20,
    "map": MOST_CELLS + (1 << 16),
    PANORAMA: 1 << 23,
    NAVIGATION: 1 << 16,
}  # bytes
_NEWEST_ONLY: Final = (NAVIGATION, SCAN, "map", PANORAMA)
_JPEG: Final = b"\xff\xd8"
Receiver = Callable[[str, bytes, bytes], None]


class RobotFeed:
    """Follows one robot and keeps the channels up to date."""

    def __init__(self, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self.bus = bus
        self.state, self.path = RobotState(), LivePath()
        self.robot: Robot | None = None
        self.link = "not connected yet"  # why there is no connection; empty with one
        self.inbox = Inbox()
        self._panorama_s = -PANORAMA_S  # when the newest one was taken
        self._poses: deque[Pose] = deque(maxlen=MOST_POSES)
        self._map_in_odom: list[float | None] | None = None
        self._large: dict[str, bytes] = {}  # newest map, panorama ... that are not processed yet
        self._wake, self._large_wake = asyncio.Event(), asyncio.Event()
        self._state_channel = Newest("state", self._encode_state)
        self._parts_channel = Newest("parts", lambda: parts_message(self.state))
        self._map_channel, self._panorama_channel = Stored("map"), Stored(PANORAMA)
        self._scan_channel, self._navigation_channel = Stored(SCAN), Stored(NAVIGATION)
        self._end_panorama: Callable[[], None] | None = None
        self.browsers = Browsers(
            (
                self._state_channel,
                self.path,
                self._parts_channel,
                self._map_channel,
                self._panorama_channel,
                self._scan_channel,
                self._navigation_channel,
            ),
            on_request=frozenset((PANORAMA,)),
        )

    async def run(self) -> None:
        """Connect to the robot as soon as it can be reached, and follow it until this task is cancelled."""
        try:
            await asyncio.gather(self._connect(), self._send_states(), self._process_large())
        finally:
            if self.robot is not None:
                self.robot.close()

    async def _send_states(self) -> None:
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(QUIET_S):
                    await self._wake.wait()
            self._wake.clear()
            self._process_inbox()
            self._forget_ended()
            self._state_channel.changed()
            self.browsers.notify()
            await asyncio.sleep(PERIOD_S)

    async def _connect(self) -> None:
        """Open the connection, take what was published before it, then subscribe to what browsers ask for."""
        loop = asyncio.get_running_loop()
        while self.robot is None:
            try:
                self.robot = await asyncio.to_thread(Robot, settings=self.bus)
            except Unreachable as error:
                self.link = str(error)
                await asyncio.sleep(RETRY_S)
        self.link = ""
        for topic in ("odom", MAP_POSE, "status", "map", SCAN, NAVIGATION):
            self.robot.on_message(self._receiver(loop), topic)
        self.robot.on_alive(self.state.set_alive)
        diagnostics, grid = await asyncio.to_thread(_latched, self.robot)
        if diagnostics is not None:
            self.state.add_diagnostics(diagnostics)
            self._parts_channel.changed()
        if grid is not None and not self._map_channel.version:
            await self._take_map(grid)
        while True:
            await asyncio.sleep(REQUEST_S)
            await self._follow_requests(self.robot, self._receiver(loop))

    def _receiver(self, loop: asyncio.AbstractEventLoop) -> Receiver:
        """Return the function that zenoh's threads call for each message."""

        def receive(topic: str, payload: bytes, attachment: bytes) -> None:
            if len(payload) > _LARGEST.get(topic, 0):
                self.state.broken += 1
                return
            if topic in _NEWEST_ONLY:
                self._large[topic] = payload  # in place of one that was not processed yet
            else:
                self.inbox.put(topic, payload, attachment)
            wake = self._large_wake if topic in self._large else self._wake
            if not wake.is_set():
                with suppress(RuntimeError):  # the event loop has ended
                    loop.call_soon_threadsafe(wake.set)

        return receive

    def _process_inbox(self) -> None:
        while (message := self.inbox.get(0.0)) is not None:
            if message.topic == MAP_POSE:
                self._take_map_pose(message.payload)
                continue
            before = self.state.pose
            pose = self.state.process(message)
            if pose is not None:
                self._add_to_path(pose, before)
            elif message.topic == "status":
                self._parts_channel.changed()

    def _take_map_pose(self, payload: bytes) -> None:
        try:
            self._map_in_odom = map_in_odom(decode_map_pose(payload), self._poses) or self._map_in_odom
        except OmnidError:
            self.state.broken += 1

    def _forget_ended(self) -> None:
        """Show no more the statuses of a daemon that has ended."""
        if self.state.forget_ended():
            self._parts_channel.changed()

    def _add_to_path(self, pose: Pose, before: Pose | None) -> None:
        """Add a pose; a smaller sequence number than before means that the daemon, and so odom, has begun again."""
        if before is not None and pose.attachment.seq < before.attachment.seq:
            self._begin_again()
        self._poses.append(pose)
        gap = before is not None and pose.attachment.resets != before.attachment.resets
        self.path.add(pose.x_m, pose.y_m, gap)

    def _begin_again(self) -> None:
        """Forget what belongs to the odom of a daemon that has ended, and let the browsers forget it."""
        self.path.clear()
        self._poses.clear()
        self._map_in_odom = None
        if self._map_channel.version:
            self._map_channel.set(no_map_message(PATH_FRAME))
        if self._scan_channel.version:
            self._scan_channel.set(no_scan_message())
        if self._navigation_channel.version:
            self._navigation_channel.set(navigation_message(NavigationReport(0, "", "", "", 0, math.nan, "", "")))
        if self._panorama_channel.version:
            self._panorama_channel.set(with_header({"type": PANORAMA, "stamp_ms": 0}, b""))

    async def _process_large(self) -> None:
        """Encode maps and panoramas; they take longer than a pose may wait."""
        while True:
            await self._large_wake.wait()
            self._large_wake.clear()
            for topic in _NEWEST_ONLY:
                payload = self._large.pop(topic, None)
                if payload is not None:
                    await self._take_large(topic, payload)
            self.browsers.notify()

    async def _take_large(self, topic: str, payload: bytes) -> None:
        try:
            if topic == SCAN:
                self._scan_channel.set(scan_message(decode_scan(payload), self._poses))
            elif topic == NAVIGATION:
                self._navigation_channel.set(navigation_message(decode_navigation(payload)))
            elif topic == "map":
                await self._take_map(await asyncio.to_thread(decode_map, payload))
            elif time.monotonic() >= self._panorama_s + PANORAMA_S:
                self._panorama_channel.set(_panorama_message(payload))
                self._panorama_s = time.monotonic()
        except (OmnidError, FrameDecodeError):
            self.state.broken += 1

    async def _take_map(self, grid: Map) -> None:
        self._map_channel.set(await asyncio.to_thread(map_message, grid))

    async def _follow_requests(self, robot: Robot, receive: Receiver) -> None:
        """Subscribe to the panorama while a browser shows it: it takes bandwidth that the robot may need."""
        wanted = self.browsers.want(PANORAMA)
        if wanted and self._end_panorama is None:
            self._end_panorama = robot.on_message(receive, PANORAMA)
        elif not wanted and self._end_panorama is not None:
            end, self._end_panorama = self._end_panorama, None
            await asyncio.to_thread(end)

    def _encode_state(self) -> str:
        return state_message(
            self.bus.robot,
            self.state,
            self.link,
            {
                "server_ms": server_ms(),
                "dropped": self.inbox.dropped,
                "browsers": len(self.browsers),
                "panoramas": self._panorama_channel.version,
                "map_in_odom": self._map_in_odom,
            },
        )


def _latched(robot: Robot) -> tuple[Diagnostics | None, Map | None]:
    """Return the status and the map that were published before the connection was made."""
    with robot.subscribe(Diagnostics) as reports:
        diagnostics = reports.newest()
    with robot.subscribe(Map) as maps:
        return diagnostics, maps.newest()


def _panorama_message(payload: bytes) -> bytes:
    """Return the message `panorama`. Raise OmnidError or FrameDecodeError if it is no JPEG image."""
    image = parse_image(COMPRESSED_IMAGE, memoryview(payload))
    data = bytes(image.data)
    if not data.startswith(_JPEG):
        raise OmnidError("the panorama is no JPEG image; expected one in sensor_msgs/msg/CompressedImage")
    return with_header({"type": PANORAMA, "stamp_ms": image.stamp_ns // 10**6}, data)
