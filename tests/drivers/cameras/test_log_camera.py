"""A log that replaces two cameras: timing, synchronisation over many passes, dropped frames."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from itertools import islice, pairwise
from pathlib import Path

import pytest

from drivers.cameras.log_camera import LogCamera, LogPlayback
from drivers.frame import CAMERAS, Frame
from drivers.logs.log_reader import LogReader
from tests.conftest import PAIRS

FAST = 50.0


def test_the_images_are_those_of_the_log(scene: Path) -> None:
    playback = LogPlayback(scene / "log.mcap", pace=FAST, once=True)
    seen: list[Frame] = list(LogCamera(playback, "upper").frames())
    with closing(LogReader(scene / "log.mcap")) as reader:
        frames = list(reader.frames())
    expected = [frame for frame in frames if frame.camera == "upper"]
    assert [frame.seq for frame in seen] == list(range(PAIRS))
    assert [bytes(frame.data) for frame in seen] == [bytes(frame.data) for frame in expected]
    for frame, original in zip(seen, expected, strict=True):
        since_ns = (original.stamp_ns - frames[0].stamp_ns) / FAST
        assert frame.stamp_ns == pytest.approx(playback.epoch_ns() + since_ns, abs=1)


def test_a_log_is_played_forwards_and_backwards_at_even_intervals(scene: Path) -> None:
    pace, open_end = 1000.0, threading.Event()
    playback = LogPlayback(scene / "log.mcap", pace=pace)
    lower, upper = (
        [pace * stamp_ns for stamp_ns, _ in islice(playback.due(camera, open_end), 6 * PAIRS)] for camera in CAMERAS
    )
    steps_ns = [b - a for a, b in pairwise(lower)]
    assert min(steps_ns) > 80e6 and max(steps_ns) < 120e6
    apart_ns = [abs(a - b) for a, b in zip(lower, upper, strict=True)]
    assert max(apart_ns) < 5e6, "both cameras reverse at the same time"


def test_a_log_starts_when_the_first_camera_is_read(scene: Path) -> None:
    """A run may load for longer than the log lasts before it takes the first image."""
    playback = LogPlayback(scene / "log.mcap", pace=1000, once=True)
    cameras = [LogCamera(playback, name) for name in ("lower", "upper")]
    streams = [camera.frames() for camera in cameras]
    read_ns = time.monotonic_ns()
    first = next(streams[1])
    assert first.stamp_ns >= playback.epoch_ns() >= read_ns and cameras[0].state.frames == 0
