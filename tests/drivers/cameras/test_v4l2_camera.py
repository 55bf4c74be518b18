"""A V4L2 camera as a source of frames: stamps, losses, and a device that is gone for a while."""

from __future__ import annotations

import errno
import logging
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraState
from drivers.cameras.v4l2_camera import BufferAccounting, StampValidator, V4l2Camera
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.frame import Frame
from tests.drivers.cameras.fake_camera import FakeCamera
from tests.waiting import wait_until

PERIOD_NS = 33_333_000
START_NS = 5_000 * 10**9
DELAY_NS = 2_000_000
MIN_BYTES = 100


def test_frames_go_on_after_a_loss_with_all_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake, events, taken = FakeCamera(tmp_path / "video0"), list[str](), list[Frame]()
    monkeypatch.setattr(v4l2, "call", fake.call)
    settings = V4l2Settings(str(tmp_path / "video0"), retry_s=0.05, timeout_s=0.2, controls=("contrast=7",))
    camera = V4l2Camera(settings, "lower", on_event=lambda _, text: events.append(text))
    reader = threading.Thread(target=lambda: taken.extend(camera.frames()), daemon=True)

    def more(*sequences: int) -> None:
        """Let images come, while the camera streams."""
        wanted = camera.state.frames + len(sequences) - (camera.state.status == "lost")
        for sequence in sequences:
            fake.fill(sequence, time.monotonic_ns())
            time.sleep(0.002)
        wait_until(lambda: camera.state.frames >= wanted)

    reader.start()
    wait_until(lambda: camera._reading)
    time.sleep(0.05)  # images from before are discarded
    more(0, 1, 4)
    assert camera.state.drops == 2 and camera.state.mode == "MJPG 1280x960 at 30 Hz"
    # 1. The device is gone, and comes back with other values.
    fake.failing = errno.ENODEV
    wait_until(lambda: camera.state.status == "lost")
    fake.values[0x00980901], fake.failing = 0, 0
    wait_until(lambda: camera.state.reopens >= 1)
    more(0, 1, 2)
    assert fake.values[0x00980901] == 7 and camera.state.status == "streaming"
    # 2. It sends nothing, and then another camera has its number.
    wait_until(lambda: "no valid image for 0.2 s" in camera.state.problem)
    fake.bus_info = b"usb-9"
    wait_until(lambda: "use a persistent name" in camera.state.problem)
    fake.bus_info = b"usb-1"
    reopens = camera.state.reopens
    wait_until(lambda: camera.state.reopens > reopens)
    more(0, 1, 2)
    camera.close()
    reader.join()
    assert [frame.seq for frame in taken] == list(range(len(taken))) and camera.state.status == "closed"
    assert all(before.stamp_ns < after.stamp_ns for before, after in pairwise(taken))
    assert [text.partition(":")[2].split(",")[0] for text in events] == [" lost", " back"] * 2


def accepted(state: CameraState, *buffers: dict[str, int]) -> list[bool]:
    accounting = BufferAccounting(state)
    usual = {"flags": v4l2.TIMESTAMP_MONOTONIC, "bytesused": MIN_BYTES}
    return [accounting.accept(v4l2.V4l2Buffer(**(usual | buffer)), MIN_BYTES) for buffer in buffers]


@pytest.mark.parametrize(
    ("sequences", "drops", "restarts"),
    [
        ((7, 8, 10, 14), 4, 0),
        ((2**32 - 2, 1), 2, 0),  # across the overflow
        ((3, 3 + 2**30), 2**30 - 1, 0),
        *(((100, again), 0, 1) for again in (0, 99, 100)),
    ],
)
def test_gaps_of_the_sequence_are_drops_and_a_restart_drops_nothing(
    sequences: tuple[int, ...], drops: int, restarts: int
) -> None:
    state = CameraState()
    accepted(state, *({"sequence": sequence} for sequence in sequences))
    assert (state.drops, state.restarts) == (drops, restarts)


@pytest.mark.parametrize("broken", [{"flags": v4l2.BUFFER_ERROR}, {"bytesused": 99}, {"bytesused": 0}])
def test_broken_buffers_are_errors_and_not_drops(broken: dict[str, int]) -> None:
    state = CameraState()
    assert accepted(state, {}, broken | {"sequence": 1}, {"sequence": 2}) == [True, False, True]
    assert (state.errors, state.drops) == (1, 0)


class Stamps:
    """A validator with its state and its events."""

    def __init__(self) -> None:
        self.state, self.events = CameraState(), list[tuple[int, str]]()
        self.validator = StampValidator("lower camera", self.state, lambda *event: self.events.append(event))

    def validate(self, stamp_ns: int, arrival_ns: int, flags: int = v4l2.TIMESTAMP_MONOTONIC) -> int:
        buffer = v4l2.V4l2Buffer(flags=flags)
        buffer.timestamp.tv_sec, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.tv_usec = rest_ns // 1000
        return self.validator.validate(buffer, arrival_ns)


@pytest.fixture
def stamps() -> Stamps:
    return Stamps()


def test_keeps_the_kernels_stamps(stamps: Stamps) -> None:
    expected = [START_NS + PERIOD_NS * number for number in range(3)]
    assert [stamps.validate(stamp_ns, stamp_ns + DELAY_NS) for stamp_ns in expected] == expected
    assert stamps.state == CameraState() and stamps.events == []


@pytest.mark.parametrize("flags", [0, 0x4000])
def test_accepts_an_undeclared_clock_with_one_warning(stamps: Stamps, flags: int) -> None:
    expected = [START_NS, START_NS + PERIOD_NS]
    assert [stamps.validate(stamp_ns, stamp_ns + DELAY_NS, flags) for stamp_ns in expected] == expected
    assert [level for level, _ in stamps.events] == [logging.WARNING]
    assert stamps.events[0][1].startswith("lower camera: ") and "clock" in stamps.events[0][1]


@pytest.mark.parametrize("stamp_ns", [0, START_NS - 11 * 10**9, 1_700_000_000 * 10**9])
def test_replaces_stamps_of_another_clock_by_the_arrival(stamps: Stamps, stamp_ns: int) -> None:
    assert stamps.validate(stamp_ns, START_NS) == START_NS
    assert stamps.state.restamped == 1


def test_stamps_increase_strictly(stamps: Stamps) -> None:
    first = stamps.validate(START_NS, START_NS + 10)
    earlier = stamps.validate(START_NS - 1000, START_NS + PERIOD_NS)
    at_the_same_time = stamps.validate(START_NS, START_NS + PERIOD_NS)
    replaced_ns = START_NS + PERIOD_NS - 10  # the arrival less the delay of the first
    assert (first, earlier, at_the_same_time) == (START_NS, replaced_ns, replaced_ns + 1)
    assert stamps.state.restamped == 2


def test_images_of_a_clock_that_fell_back_are_dated_by_their_arrival_for_good(stamps: Stamps) -> None:
    found = []
    for number in range(300):
        taken_ns = START_NS + PERIOD_NS * number
        kernel_ns = taken_ns - 3 * 10**9 * (number >= 30)
        found.append(stamps.validate(kernel_ns, taken_ns + DELAY_NS) - taken_ns)
    assert found == [0] * 300 and stamps.state.restamped == 270
