"""What the daemon in the guest lives among: a world before its cameras, and an operator who drives."""

from __future__ import annotations

import bisect
import threading
import time
from pathlib import Path
from typing import NamedTuple

from drivers.cameras.log_camera import LogImages
from drivers.frame import Camera
from omnid.client import Diagnostics, Pose, Robot
from omnid.transport.decode import decode_diagnostics, decode_pose
from tests.hardware.guest.loopback import DEVICES, Loopback
from tests.hardware.guest.unit import until

SAMPLE = Path("/opt/omnid/omnid/sample")
SIZE = 512, 512
AGAIN_S = 0.5  # a camera shows a image that often
CAMERAS: tuple[Camera, ...] = ("lower", "upper")


class Shown(NamedTuple):
    """A image of the lower camera and when it was written."""

    at_ns: int  # CLOCK_MONOTONIC
    number: int  # in the log


class World:
    """What is before the cameras: the log, forwards and backwards, one step after each pose that was told of it."""

    def __init__(self) -> None:
        images = LogImages.load(SAMPLE / "log.mcap")
        self._data = [[bytes(timed[1].data) for timed in eye] for eye in (images.lower, images.upper)]
        self._last = min(map(len, self._data)) - 1
        self._step, self._moved = 0, threading.Event()
        self._eyes: dict[Camera, Loopback] = {}
        self._lock = threading.Lock()
        self.shown: list[Shown] = []
        for camera in CAMERAS:
            self.open(camera)
        threading.Thread(target=self._show_on, daemon=True).start()

    def open(self, camera: Camera) -> None:
        """The camera shows images."""
        with self._lock:
            self._eyes[camera] = Loopback(DEVICES[CAMERAS.index(camera)], "MJPG", SIZE)

    def close(self, camera: Camera) -> None:
        """The camera shows nothing more."""
        with self._lock:
            self._eyes.pop(camera).close()

    def index(self, at_ns: int) -> int:
        """Which image was shown at that time."""
        return self.shown[max(0, bisect.bisect([entry.at_ns for entry in self.shown], at_ns) - 1)].number

    def heed(self, at_ns: int) -> None:
        """There is a pose of the images of that time: if they are those that are shown, on to the next."""
        if self.shown and self.index(at_ns) == self._index:
            self._step += 1
            self._moved.set()

    @property
    def _index(self) -> int:
        return self._last - abs(self._step % (2 * self._last) - self._last)

    def _show_on(self) -> None:
        while True:
            self._moved.clear()
            self._show(self._index)
            self._moved.wait(AGAIN_S)

    def _show(self, index: int) -> None:
        with self._lock:
            self.shown.append(Shown(time.monotonic_ns(), index))
            for data, camera in zip(self._data, CAMERAS, strict=True):
                if camera in self._eyes:
                    self._eyes[camera].write(data[index])


class Operator:
    """Hears the daemon and sends it commands, several in a second, while it wants the robot to drive."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self.poses: list[Pose] = []
        self.report: Diagnostics | None = None
        self.driving = False
        self._robot = Robot(timeout_s=60.0)
        self._robot.each(self._take)
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._drive, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leaves; a session that is open keeps Python from ending."""
        self._leaving.set()
        self._thread.join()
        self._robot.close()

    def index(self, pose: Pose) -> int:
        """The image it is a pose of."""
        return self._world.index(pose.stamp_ns - self._offset_ns)

    def message(self, part: str) -> str:
        """What the daemon last said of a part."""
        statuses = () if self.report is None else self.report.statuses
        return next((status.message for status in statuses if status.name == f"omnid: {part}"), "")

    def more(self, count: int) -> list[Pose]:
        """Waits for so many more poses."""
        before = len(self.poses)
        until(lambda: len(self.poses) >= before + count)
        return self.poses[before:]

    def _take(self, topic: str, payload: bytes, note: bytes) -> None:
        if topic == "odom":
            self.poses.append(decode_pose(payload, note))
            self._world.heed(self.poses[-1].stamp_ns - self._offset_ns)
        elif topic == "status" and len((report := decode_diagnostics(payload)).statuses) > 1:  # else of a change alone
            self.report = report

    def _drive(self) -> None:
        driver = self._robot.driver()
        while not self._leaving.wait(0.3):
            if self.driving:
                driver.twist(0.3, 0.0)
