"""Run by pytest in the guest, as root: the camera driver on vivid and v4l2loopback, the kernel's own virtual cameras.

vivid is loaded again for each test; its two cameras are called /dev/omnid/lower and upper by the rules that `omnid
cameras` prints. v4l2loopback delivers the images that a test writes.
"""

from __future__ import annotations

import gc
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_camera import V4l2Camera
from drivers.cameras.v4l2_device import V4l2Settings
from drivers.frame import Frame, gray
from tests.hardware.guest.surroundings import DEVICES, Loopback, load_loopback

SIZE = 320, 180
RATE_HZ = 10.0
LIMIT_S = 40.0
LOWER, UPPER = "/dev/omnid/lower", "/dev/omnid/upper"
BIND = Path("/sys/bus/platform/drivers/vivid")
DISCONNECT = 0xF0F041  # vivid's own control
# the start of the exposure as stamp: the end of the frame lies in the future; no text within the image
STILL = ("timestamp_source=1", "osd_text_mode=2")
LATE_STAMPS = 2  # gaps that stamps of a virtual camera may show too many or too few on a busy machine


def run(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def press(device: str, control_id: int) -> None:
    """Press a control without the driver."""
    fd = os.open(device, os.O_RDWR)
    try:
        v4l2.call(fd, "S_CTRL", v4l2.V4l2Control(control_id, 1))
    finally:
        os.close(fd)


def until(what: Callable[[], object], limit_s: float = LIMIT_S) -> None:
    end_s = time.monotonic() + limit_s
    while not what():
        assert time.monotonic() < end_s, "condition not met in time"
        time.sleep(0.02)


class CameraReader:
    """A camera that is read by a thread; `taken`: seq, stamp and arrival of each frame."""

    def __init__(self, device: str = LOWER, **fields: Any) -> None:
        fields = {
            "width_px": SIZE[0],
            "height_px": SIZE[1],
            "rate_hz": RATE_HZ,
            "pixel_format": "GREY",
            "timeout_s": 5.0,
            "controls": STILL,
        } | fields
        self.events: list[tuple[int, str]] = []
        self.taken: list[tuple[int, int, int]] = []
        self.last: Frame | None = None
        settings = V4l2Settings(device, **fields)
        self.camera = V4l2Camera(settings, "lower", on_event=lambda *event: self.events.append(event))
        self.state = self.camera.state
        self.thread = threading.Thread(target=self._read, daemon=True)

    def _read(self) -> None:
        for frame in self.camera.frames():
            self.taken.append((frame.seq, frame.stamp_ns, time.monotonic_ns()))
            self.last = frame

    def __enter__(self) -> CameraReader:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.camera.close()
        self.thread.join(LIMIT_S)
        assert not self.thread.is_alive(), "close() did not end frames()"

    def more(self, count: int) -> None:
        """Wait for more frames."""
        goal = len(self.taken) + count
        until(lambda: len(self.taken) >= goal)

    def missing(self, period_ns: int = round(1e9 / RATE_HZ)) -> int:
        """Return the number of missing frames by their stamps, which vivid sets to multiples of its period."""
        stamps = [stamp_ns for _, stamp_ns, _ in self.taken]
        return sum(round((after - before) / period_ns) - 1 for before, after in pairwise(stamps))

    def require_order(self) -> None:
        """Require numbers without a gap, and increasing stamps in the past."""
        assert [seq for seq, _, _ in self.taken] == list(range(len(self.taken)))
        stamps = [stamp_ns for _, stamp_ns, _ in self.taken]
        assert all(before < after for before, after in pairwise(stamps))
        assert all(stamp_ns <= arrival_ns for _, stamp_ns, arrival_ns in self.taken)

    def require_events(self, *words: str) -> None:
        """Require events with these words in this order, and no others."""
        assert len(self.events) == len(words), self.events
        assert all(word in text for word, (_, text) in zip(words, self.events, strict=True)), self.events


class Writer:
    """Writes an image to a loopback camera again and again, as a webcam does."""

    def __init__(self, device: str, image: bytes, pixel_format: str = "GREY") -> None:
        self._loopback = Loopback(device, pixel_format, SIZE)
        self._image, self._halt = image, threading.Event()
        self._thread = threading.Thread(target=self._write, daemon=True)

    def _write(self) -> None:
        while not self._halt.wait(1 / RATE_HZ):
            self._loopback.write(self._image)

    def __enter__(self) -> Writer:
        self._loopback.write(self._image)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._halt.set()
        self._thread.join()
        self._loopback.close()


@pytest.fixture(scope="session")
def rules() -> Path:
    """The rules that name the two cameras, installed."""
    path = Path("/run/udev/rules.d/70-cameras.rules")
    run("modprobe", "vivid", "n_devs=2", "node_types=0x1,0x1")
    run("udevadm", "settle")
    printed = run("python3", "-m", "omnid", "cameras")
    # Both are at one port of the kernel's, so that a rule for ports cannot tell them apart.
    names = zip(("vivid-000-vid-cap", "vivid-001-vid-cap"), (LOWER, UPPER), strict=True)
    found = [f'SUBSYSTEM=="video4linux", ATTR{{name}}=="{name}", SYMLINK+="{link[5:]}"' for name, link in names]
    assert "vivid-001-vid-cap" in printed and "--list-formats-ext" in printed
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(found) + "\n", "utf-8")
    run("modprobe", "-r", "vivid")
    run("udevadm", "control", "--reload")
    return path


@pytest.fixture
def vivid(rules: Path) -> Iterator[None]:
    """Two newly loaded cameras with their persistent names."""
    run("modprobe", "vivid", "n_devs=2", "node_types=0x1,0x1")
    run("udevadm", "settle")
    assert {os.readlink(LOWER), os.readlink(UPPER)} == {"../video0", "../video1"}
    yield
    run("modprobe", "-r", "vivid")


@pytest.fixture(scope="session")
def loopback() -> None:
    load_loopback()


@pytest.fixture(autouse=True)
def no_file_stays_open() -> Iterator[None]:
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    yield
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before


def test_four_cameras_stream_at_their_rate(vivid: None, loopback: None) -> None:
    image = bytes(SIZE[0] * SIZE[1])
    with Writer(DEVICES[0], image), Writer(DEVICES[1], image):
        real = [CameraReader(LOWER), CameraReader(UPPER)]
        looped = [CameraReader(device, controls=()) for device in DEVICES]
        with real[0], real[1], looped[0], looped[1]:
            until(lambda: all(len(watched.taken) >= 20 for watched in real + looped))
    for watched in real + looped:
        watched.require_order()
        period_ns = (watched.taken[-1][1] - watched.taken[0][1]) / (len(watched.taken) - 1 + watched.state.drops)
        print(watched.state, f"{1e9 / period_ns:.2f} Hz")
        assert 0.5 < 1e9 / period_ns / RATE_HZ < 1.5
    for watched in real:
        watched.require_events()
        assert watched.state.mode == "GREY 320x180 at 10 Hz"
        assert abs(watched.missing() - watched.state.drops) <= LATE_STAMPS
    for watched in looped:
        watched.require_events("clock")


def test_dropped_buffers_are_counted(vivid: None) -> None:
    """The count equals the gaps in the stamps, which the virtual camera sets late on a busy machine."""
    with CameraReader(controls=(*STILL, "percentage_of_dropped_buffers=40"), rate_hz=25.0) as watched:
        watched.more(60)
    watched.require_order()
    assert watched.state.drops > 5 and abs(watched.state.drops - watched.missing(40_000_000)) <= LATE_STAMPS
    assert watched.state.frames == len(watched.taken) and watched.state.errors == watched.state.losses == 0


def test_both_cameras_are_unplugged_and_reconnected(vivid: None) -> None:
    with CameraReader(LOWER) as lower, CameraReader(UPPER) as upper:
        lower.more(5)
        upper.more(5)
        press(LOWER, DISCONNECT)
        # vivid reconnects when it is closed
        until(lambda: lower.state.losses == 1 and lower.state.status == "streaming")
        upper.more(5)
        assert upper.state.losses == 0
        (BIND / "unbind").write_text("vivid.0")
        until(lambda: "is not there" in lower.state.problem and "is not there" in upper.state.problem)
        assert not os.path.lexists(LOWER)
        (BIND / "bind").write_text("vivid.0")
        for watched in (lower, upper):
            until(lambda watched=watched: watched.state.status == "streaming")
            watched.more(5)
    lower.require_order()
    upper.require_order()
    lower.require_events("lost", "back", "lost", "back")
    upper.require_events("lost", "back")


def test_motion_jpeg_arrives_whole(loopback: None) -> None:
    image = np.tile(np.linspace(0, 255, SIZE[0], dtype=np.uint8), (SIZE[1], 1))
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    with Writer(DEVICES[0], jpeg, "MJPG"), CameraReader(DEVICES[0], controls=(), pixel_format="auto") as watched:
        watched.more(5)
    assert watched.last and watched.last.encoding == "jpeg"
    assert np.abs(gray(watched.last).astype(int) - image).max() < 12
