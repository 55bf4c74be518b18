"""A recorded log that replaces live cameras: at a chosen pace, stamped with the time of delivery."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Final, TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.log_reader import BY_NAME, LogCameras, LogReader

MAX_LOG_BYTES: Final = 1 << 30
MAX_DELAY_NS: Final = 100_000_000  # a frame later than that is dropped, as by a camera whose buffers are full
TimedFrames: TypeAlias = tuple[tuple[int, Frame], ...]  # time since the log's first frame [ns], frame


@dataclass(frozen=True, slots=True)
class LogImages:
    """The frames of both cameras of a log in memory."""

    lower: TimedFrames
    upper: TimedFrames
    warnings: tuple[str, ...] = ()  # of the reader, a line each

    @staticmethod
    def load(path: Path, cameras: LogCameras = BY_NAME) -> LogImages:
        """Load the images of a log; DriverError where a camera has fewer than two images, and beyond MAX_LOG_BYTES."""
        frames, left_bytes = list[Frame](), MAX_LOG_BYTES
        with closing(LogReader(path, cameras)) as reader:
            for frame in reader.frames():
                frames.append(frame)
                left_bytes -= len(frame.data)  # LogReader delivers bytes
                if left_bytes < 0:
                    most = MAX_LOG_BYTES >> 20
                    raise DriverError(f"{path}: more than {most} MiB of images: cut the log into shorter ones")
        first_ns = frames[0].stamp_ns if frames else 0
        lower_frames, upper_frames = (
            tuple((frame.stamp_ns - first_ns, frame) for frame in frames if frame.camera == camera)
            for camera in CAMERAS
        )
        if min(len(lower_frames), len(upper_frames)) < 2:
            raise DriverError(
                f"{path}: {len(lower_frames)} images of the lower and {len(upper_frames)} of the "
                "upper camera: give a log with two or more of each"
            )
        return LogImages(lower_frames, upper_frames, tuple(reader.warnings))

    @property
    def last_ns(self) -> int:
        """Time of the last image [ns since the first]."""
        return max(self.lower[-1][0], self.upper[-1][0])

    @property
    def pass_ns(self) -> int:
        """Time from one pass to the next [ns]: the log and one period, the same for both cameras."""
        return self.last_ns + max(1, self.last_ns // (max(len(self.lower), len(self.upper)) - 1))


class LogPlayback:
    """A log that is played forwards and backwards in turn, for both cameras.

    It starts when the first of them begins to deliver: a run that loads for some time before it takes images loses
    none of them.
    """

    def __init__(self, images: LogImages, *, pace: float = 1.0, once: bool = False) -> None:
        """pace: speed relative to the recording; DriverError where it is not above 0. once: play once, forwards."""
        if not 0 < pace < math.inf:
            raise DriverError(f"the pace of a log is {pace:g}; give a number above 0; 2 is twice as fast as recorded")
        self.images, self.pace, self._once = images, pace, once
        self._epoch_ns: int | None = None
        self._lock = threading.Lock()

    def epoch_ns(self) -> int:
        """Return the start of the log [ns of CLOCK_MONOTONIC]; the first call, from any thread, starts it."""
        with self._lock:
            if self._epoch_ns is None:
                self._epoch_ns = time.monotonic_ns()
            return self._epoch_ns

    def due(self, frames: TimedFrames, closed: threading.Event) -> Iterator[tuple[int, Frame]]:
        """Yield stamp [ns] and frame when each frame is due, until closed."""
        epoch_ns = self.epoch_ns()
        for at_ns, frame in self._passes(frames):
            stamp_ns = epoch_ns + round(at_ns / self.pace)
            if closed.wait(max(0.0, (stamp_ns - time.monotonic_ns()) * 1e-9)):
                return
            yield stamp_ns, frame

    def _passes(self, frames: TimedFrames) -> Iterator[tuple[int, Frame]]:
        """Yield time since the epoch at pace 1 [ns] and frame, pass after pass."""
        images = self.images
        for start_ns in count(0, 2 * images.pass_ns):
            yield from ((start_ns + at_ns, frame) for at_ns, frame in frames)
            if self._once:
                return
            turned_ns = start_ns + images.pass_ns + images.last_ns
            yield from ((turned_ns - at_ns, frame) for at_ns, frame in reversed(frames))


class LogCamera:
    """One camera of a log. The stamp of a frame is the time at which it is due."""

    def __init__(self, playback: LogPlayback, camera: Camera) -> None:
        self._playback = playback
        self._entries = playback.images.lower if camera == "lower" else playback.images.upper
        self._closed = threading.Event()
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames when they are due, until closed; those that are not read in time are dropped and counted."""
        for seq, (stamp_ns, frame) in enumerate(self._playback.due(self._entries, self._closed)):
            if time.monotonic_ns() <= stamp_ns + MAX_DELAY_NS:
                self.state.status = "streaming"
                self.state.frames += 1
                yield replace(frame, seq=seq, stamp_ns=stamp_ns)
            else:
                self.state.drops += 1
        self.state.status = "closed"

    def close(self) -> None:
        """End the frames; may be called twice, from any thread."""
        self._closed.set()
