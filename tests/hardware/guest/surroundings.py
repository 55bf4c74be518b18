"""The surroundings of the daemon in the guest: its unit, cameras with given images, and an operator who drives."""

from __future__ import annotations

import bisect
import os
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.log_camera import LogPlayback
from drivers.frame import Camera
from omnid.client import Diagnostics, Pose, Robot, Unreachable
from omnid.transport.codec import decode_diagnostics, decode_pose

SYSTEMD = Path("/opt/omnid/systemd")
DROP_INS = Path("/etc/systemd/system/omnid.service.d")
LIMIT_S = 400.0  # The clock of a guest on a busy host may run several times too fast.
SAMPLE = Path("/opt/omnid/omnid/sample")
SIZE = 512, 512
REPEAT_S = 0.5  # period of an image that is repeated
MAX_REPEATS = 40  # of images without a pose: a slow daemon that paired one with that before leaves it out as repeated
CAMERAS: tuple[Camera, ...] = ("lower", "upper")


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    journal = ("journalctl", "-u", "omnid", "-n", "40")  # why a unit does not start
    assert done.returncode == 0, done.stderr + subprocess.run(journal, capture_output=True, text=True).stdout
    return done.stdout.strip()


def show(what: str) -> str:
    return run("systemctl", "show", "omnid", "-p", what, "--value")


def until(what: Callable[[], object]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not what():
        assert time.monotonic() < end_s, run("journalctl", "-u", "omnid", "--no-pager", "-n", "60")
        time.sleep(0.3)


def wait_for_restart(pid: int) -> None:
    """Wait until another process is the daemon."""
    until(lambda: int(show("MainPID")) not in (0, pid) and show("ActiveState") == "active")


def journal() -> list[str]:
    """Return the texts of all lines in the journal of the unit."""
    return run("journalctl", "-u", "omnid", "--no-pager", "-o", "cat").splitlines()


class Shown(NamedTuple):
    """An image of the lower camera and the time at which it was written."""

    at_ns: int  # CLOCK_MONOTONIC
    number: int  # in the log


class SampleLog:
    """The sample log on both cameras, forwards and backwards, one step after each published pose, or MAX_REPEATS."""

    def __init__(self) -> None:
        images = LogPlayback(SAMPLE / "log.mcap").frames
        self._data = [[bytes(timed[1].data) for timed in frames] for frames in images.values()]
        self._last = min(map(len, self._data)) - 1
        self._step, self._has_pose = 0, threading.Event()
        self._cameras: dict[Camera, Loopback] = {}
        self._lock = threading.Lock()
        self.shown: list[Shown] = []
        for camera in CAMERAS:
            self.open(camera)
        threading.Thread(target=self._run, daemon=True).start()

    def open(self, camera: Camera) -> None:
        """Connect a camera."""
        with self._lock:
            self._cameras[camera] = Loopback(DEVICES[CAMERAS.index(camera)], "MJPG", SIZE)

    def close(self, camera: Camera) -> None:
        """Disconnect a camera."""
        with self._lock:
            self._cameras.pop(camera).close()

    def index(self, at_ns: int) -> int:
        """Return the number of the image that was shown at a time."""
        return self.shown[max(0, bisect.bisect([entry.at_ns for entry in self.shown], at_ns) - 1)].number

    def on_pose(self, at_ns: int) -> None:
        """Have the next images shown after a pose of those that are shown now."""
        if self.shown and self.index(at_ns) == self._index:
            self._has_pose.set()

    @property
    def _index(self) -> int:
        return self._last - abs(self._step % (2 * self._last) - self._last)

    def _run(self) -> None:
        while True:
            self._has_pose.clear()
            for _ in range(MAX_REPEATS):
                self._show(self._index)
                if self._has_pose.wait(REPEAT_S):
                    break
            self._step += 1

    def _show(self, index: int) -> None:
        with self._lock:
            self.shown.append(Shown(time.monotonic_ns(), index))
            for data, camera in zip(self._data, CAMERAS, strict=True):
                if camera in self._cameras:
                    self._cameras[camera].write(data[index])


class GuestOperator:
    """Receives the messages of the daemon, and sends it commands at 3 Hz while `driving` is set."""

    def __init__(self, sample_log: SampleLog) -> None:
        self._sample_log = sample_log
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self.poses: list[Pose] = []
        self.report: Diagnostics | None = None
        self.driving = False
        deadline_s = time.monotonic() + 60.0
        while True:
            try:
                self._robot = Robot()
                break
            except Unreachable:
                if time.monotonic() > deadline_s:
                    raise
        self._robot.on_message(self._receive)
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._drive, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the session, which would keep Python from ending."""
        self._leaving.set()
        self._thread.join()
        self._robot.close()

    def message(self, part: str) -> str:
        """Return the last status message of a part of the daemon."""
        statuses = () if self.report is None else self.report.statuses
        return next((status.message for status in statuses if status.name == f"omnid: {part}"), "")

    def more(self, count: int) -> list[Pose]:
        """Wait for more poses and return them."""
        before = len(self.poses)
        until(lambda: len(self.poses) >= before + count)
        return self.poses[before:]

    def _receive(self, topic: str, payload: bytes, note: bytes) -> None:
        if topic == "odom":
            self.poses.append(decode_pose(payload, note))
            self._sample_log.on_pose(self.poses[-1].stamp_ns - self._offset_ns)
        elif topic == "status" and len((report := decode_diagnostics(payload)).statuses) > 1:  # else of a change alone
            self.report = report

    def _drive(self) -> None:
        driver = self._robot.driver()
        while not self._leaving.wait(0.3):
            if self.driving:
                driver.twist(0.3, 0.0)


DEVICES = "/dev/video10", "/dev/video11"
OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT


def load_loopback() -> None:
    """Load two loopback cameras with 4 buffers: with more, a reader that requests 4 has crashed the kernel."""
    subprocess.run(
        [
            "modprobe",
            "v4l2loopback",
            "devices=2",
            "video_nr=10,11",
            "card_label=omni-lower,omni-upper",
            "exclusive_caps=1,1",
            "max_buffers=4",
        ],
        check=True,
    )
    subprocess.run(["udevadm", "settle"], check=True)


class Loopback:
    """The writing end of a loopback camera, which is a capture device from the first image until it is closed."""

    def __init__(self, device: str, pixel_format: str, size_px: tuple[int, int]) -> None:
        self._fd = os.open(device, os.O_RDWR)
        asked = v4l2.Format(type=OUTPUT)
        pix = asked.fmt.pix
        pix.width, pix.height, pix.pixelformat, pix.field = *size_px, v4l2.fourcc_code(pixel_format), v4l2.PROGRESSIVE
        v4l2.call(self._fd, "S_FMT", asked)
        v4l2.call(self._fd, "STREAMON", v4l2.Int32(OUTPUT))  # else the end of the writer is not visible to readers

    def write(self, image: bytes) -> None:
        """Write an image; the kernel stamps it now."""
        os.write(self._fd, image)

    def close(self) -> None:
        """Stop the images, which a reader sees as a lost camera."""
        os.close(self._fd)
