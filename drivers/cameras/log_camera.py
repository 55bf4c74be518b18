"""A recorded log that replaces live cameras, wheels and IMU: at a chosen pace, stamped with the time of delivery."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from drivers.cameras.camera_state import CameraState
from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.log_reader import LogReader
from drivers.logs.streams import MotionTopics
from drivers.motion import MotionSample

MAX_LOG_BYTES: Final = 1 << 30
POLL_PERIOD_S: Final = 0.02  # A wait is interrupted with this period to see whether close() was called.
MAX_DELAY_NS: Final = 100_000_000  # a frame later than that is dropped, as by a camera whose buffers are full
T = TypeVar("T")
TimedFrames: TypeAlias = tuple[tuple[int, Frame], ...]  # time since the log's first frame [ns], frame


@dataclass(frozen=True, slots=True)
class LogImages:
    """The frames of both cameras of a log in memory, and the samples of its wheels and IMU."""

    lower: TimedFrames
    upper: TimedFrames
    motion: tuple[tuple[int, MotionSample], ...] = ()  # time since the log's first frame [ns], sample
    warnings: tuple[str, ...] = ()  # of the reader, a line each

    @staticmethod
    def load(
        path: Path,
        lower: str | None = None,
        upper: str | None = None,
        motion: MotionTopics | None = None,
        bits: int = 16,
    ) -> LogImages:
        """Load the images of a log. lower, upper: topics, where their names do not identify the cameras.

        motion: topics of wheels and IMU; None: they are not read. bits: see Frame. Raises DriverError where a camera
        has fewer than two images, and beyond MAX_LOG_BYTES.
        """
        frames, samples, left_bytes = list[Frame](), list[MotionSample](), MAX_LOG_BYTES
        with closing(LogReader(path, lower, upper, motion=motion, bits=bits)) as reader:
            for message in reader.messages():
                if not isinstance(message, Frame):
                    samples.append(message)
                    continue
                frames.append(message)
                left_bytes -= len(message.data)  # LogReader delivers bytes
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
        timed = tuple((sample.stamp_ns - first_ns, sample) for sample in samples)
        return LogImages(lower_frames, upper_frames, timed, tuple(reader.warnings))

    @property
    def last_ns(self) -> int:
        """Time of the last image [ns since the first]."""
        return max(self.lower[-1][0], self.upper[-1][0])

    @property
    def pass_ns(self) -> int:
        """Time from one pass to the next [ns]: the log and one period, the same for both cameras."""
        return self.last_ns + max(1, self.last_ns // (max(len(self.lower), len(self.upper)) - 1))


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


class _Playback:
    """A part of a log, played forwards and backwards in turn until it is closed.

    clock: start of the log, shared by the cameras and the motion. pace: speed relative to the recording. once: play the
    log once, forwards. Raises DriverError for a pace that is not above 0.
    """

    def __init__(self, images: LogImages, clock: LogClock, *, pace: float = 1.0, once: bool = False) -> None:
        if not 0 < pace < math.inf:
            raise DriverError(f"the pace of a log is {pace:g}; give a number above 0; 2 is twice as fast as recorded")
        self._images, self._clock, self._pace, self._once = images, clock, pace, once
        self._closed = False

    def close(self) -> None:
        """End the playback; may be called twice, from any thread."""
        self._closed = True

    def _due(self, entries: Sequence[tuple[int, T]]) -> Iterator[tuple[int, T, int]]:
        """Yield stamp [ns], entry and direction of the pass when each entry is due, until closed."""
        epoch_ns = self._clock.epoch_ns()
        for due_ns, entry, direction in passes_of(entries, self._images, self._once):
            stamp_ns = epoch_ns + round(due_ns / self._pace)
            while not self._closed and (left_s := (stamp_ns - time.monotonic_ns()) * 1e-9) > 0:
                time.sleep(min(left_s, POLL_PERIOD_S))
            if self._closed:
                return
            yield stamp_ns, entry, direction


class LogCamera(_Playback):
    """One camera of a log.

    The stamp of a frame is the time at which it is due; frames that are due before the construction are not delivered.
    """

    def __init__(
        self, images: LogImages, camera: Camera, clock: LogClock, *, pace: float = 1.0, once: bool = False
    ) -> None:
        super().__init__(images, clock, pace=pace, once=once)
        self._frames = images.lower if camera == "lower" else images.upper
        self._created_ns = time.monotonic_ns()
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames when they are due, until closed; those that are not read in time are dropped and counted."""
        for seq, (stamp_ns, frame, _) in enumerate(self._due(self._frames)):
            if time.monotonic_ns() <= stamp_ns + MAX_DELAY_NS:
                self.state.status = "streaming"
                self.state.frames += 1
                yield replace(frame, seq=seq, stamp_ns=stamp_ns)
            else:
                self.state.drops += stamp_ns > self._created_ns
        self.state.status = "closed"


class LogMotion(_Playback):
    """Wheels and IMU of a log, played as its cameras are: on the way back all rates have the other sign."""

    def samples(self) -> Iterator[MotionSample]:
        """Yield the samples when they are due, until closed."""
        for stamp_ns, sample, direction in self._due(self._images.motion) if self._images.motion else ():
            rates = [name for name in sample.__slots__ if name.endswith("ps")]
            faster = {name: direction * self._pace * getattr(sample, name) for name in rates}
            yield replace(sample, stamp_ns=stamp_ns, **faster)


def passes_of(entries: Sequence[tuple[int, T]], images: LogImages, once: bool) -> Iterator[tuple[int, T, int]]:
    """Yield the entries of a log pass after pass, every second pass backwards.

    Each has its time since the epoch at pace 1 [ns], and the direction of the pass: 1, or -1 backwards. once: one pass.
    """
    for start_ns in count(0, 2 * images.pass_ns):
        yield from ((start_ns + at_ns, entry, 1) for at_ns, entry in entries)
        if once:
            return
        turned_ns = start_ns + images.pass_ns + images.last_ns
        yield from ((turned_ns - at_ns, entry, -1) for at_ns, entry in reversed(entries))
