"""A recorded log that replaces a live camera: its images at a chosen pace, stamped with the time of delivery."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Final, TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.errors import DriverError
from drivers.frame import Camera, Frame
from drivers.logs.log_reader import LogReader

MAX_LOG_BYTES: Final = 1 << 30
MIN_PACE, MAX_PACE = 0.001, 1000.0
POLL_PERIOD_S: Final = 0.02  # between two checks for close()
MAX_DELAY_NS: Final = 100_000_000  # a frame later than that is dropped, as by a camera whose buffers are full
TimedFrames: TypeAlias = tuple[tuple[int, Frame], ...]  # time since the log's first frame [ns], frame


@dataclass(frozen=True, slots=True)
class LogImages:
    """The frames of both cameras of a log in memory."""

    lower: TimedFrames
    upper: TimedFrames

    @staticmethod
    def load(path: Path, lower: str | None = None, upper: str | None = None) -> LogImages:
        """Load the images of a log. lower, upper: topics, where their names do not identify the cameras.

        Raises DriverError where a camera has fewer than two images, and beyond MAX_LOG_BYTES.
        """
        reader = LogReader(path, lower, upper)
        try:
            frames = list(_limited(reader.frames(), path))
        finally:
            reader.close()
        timed = [(frame.stamp_ns - frames[0].stamp_ns, frame) for frame in frames]
        images = LogImages(lower=tuple(entry for entry in timed if entry[1].camera == "lower"),
                           upper=tuple(entry for entry in timed if entry[1].camera == "upper"))
        if min(len(images.lower), len(images.upper)) < 2:
            raise DriverError(f"{path}: {len(images.lower)} images of the lower and {len(images.upper)} of the "
                              "upper camera: give a log with two or more of each")
        return images

    @property
    def last_ns(self) -> int:
        """Time of the last image [ns since the first]."""
        return max(self.lower[-1][0], self.upper[-1][0])

    @property
    def pass_ns(self) -> int:
        """Time from one pass to the next [ns]: the log and one period, the same for both cameras."""
        return self.last_ns + max(1, self.last_ns // (max(len(self.lower), len(self.upper)) - 1))


def _limited(frames: Iterator[Frame], path: Path) -> Iterator[Frame]:
    total_bytes = 0
    for frame in frames:
        total_bytes += len(frame.data)  # LogReader delivers bytes
        if total_bytes > MAX_LOG_BYTES:
            raise DriverError(f"{path}: more than {MAX_LOG_BYTES >> 20} MiB of images: cut the log into shorter ones")
        yield frame


class LogClock:
    """The time at which a log starts, the same for both cameras: when the first of them begins to deliver.

    A run that loads for some time before it takes images loses none of them.
    """

    def __init__(self, epoch_ns: int | None = None) -> None:
        """epoch_ns: a fixed start of the log [ns of CLOCK_MONOTONIC]."""
        self._epoch_ns = epoch_ns
        self._lock = threading.Lock()

    def epoch_ns(self) -> int:
        """Return the start of the log [ns of CLOCK_MONOTONIC]; the first call, from any thread, starts it."""
        with self._lock:
            if self._epoch_ns is None:
                self._epoch_ns = time.monotonic_ns()
            return self._epoch_ns


class LogCamera:
    """One camera of a log, played forwards and backwards until it is closed.

    clock: start of the log, shared by both cameras. pace: speed relative to the recording. once: play the log once,
    forwards. The stamp of a frame is the time at which it is due; frames that are due before the construction are not
    delivered. Raises DriverError for a pace out of range.
    """

    def __init__(self, images: LogImages, camera: Camera, clock: LogClock, *, pace: float = 1.0, once: bool = False
                 ) -> None:
        if not MIN_PACE <= pace <= MAX_PACE:
            raise DriverError(f"the pace of a log is {pace:g}; give a number from {MIN_PACE:g} to {MAX_PACE:g}; above "
                              "1 is faster than it was recorded")
        self._images, self._frames = images, images.lower if camera == "lower" else images.upper
        self._clock, self._pace, self._once = clock, pace, once
        self._created_ns = time.monotonic_ns()
        self._closed = False
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames when they are due, until closed; those that are not read in time are dropped and counted."""
        epoch_ns = self._clock.epoch_ns()
        for seq, (due_ns, frame) in enumerate(self._schedule()):
            stamp_ns = epoch_ns + round(due_ns / self._pace)
            self._sleep_until(stamp_ns)
            if self._closed:
                break
            if time.monotonic_ns() <= stamp_ns + MAX_DELAY_NS:
                self.state.status = "streaming"
                self.state.frames += 1
                yield replace(frame, seq=seq, stamp_ns=stamp_ns)
            else:
                self.state.drops += stamp_ns > self._created_ns
        self.state.status = "closed"

    def close(self) -> None:
        """End frames(); may be called twice, from any thread."""
        self._closed = True

    def _schedule(self) -> Iterator[tuple[int, Frame]]:
        """Yield each frame with its time since the epoch at pace 1 [ns]; every second pass runs backwards."""
        last_ns, pass_ns = self._images.last_ns, self._images.pass_ns
        for start_ns in count(0, 2 * pass_ns):
            yield from ((start_ns + at_ns, frame) for at_ns, frame in self._frames)
            if self._once:
                return
            yield from ((start_ns + pass_ns + last_ns - at_ns, frame) for at_ns, frame in reversed(self._frames))

    def _sleep_until(self, due_ns: int) -> None:
        while not self._closed and (left_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, POLL_PERIOD_S))
