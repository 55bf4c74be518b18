"""A recorded log in the place of a live camera: real images, at their pace or another, stamped as they are given."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from drivers.cameras.v4l2_buffers import CameraState
from drivers.errors import DriverError
from drivers.frame import Camera, Frame
from drivers.logs.mcap_reader import LogReader

MOST_BYTES = 1 << 30
SLOWEST, FASTEST = 0.001, 1000.0  # paces
NAP_S = 0.02
LATEST_NS = 100_000_000  # what comes later than that is left out, as by a camera whose buffers are full
Timed = tuple[tuple[int, Frame], ...]  # in order, each with its time since the log's first frame [ns]


@dataclass(frozen=True, slots=True)
class LogImages:
    """The frames of both cameras, held in memory."""

    lower: Timed
    upper: Timed

    @staticmethod
    def of(path: Path, lower: str | None = None, upper: str | None = None) -> LogImages:
        """The images of a log, two or more of each camera; DriverError else, and beyond MOST_BYTES."""
        reader = LogReader(path, lower, upper)
        try:
            frames = list(_bounded(reader.frames(), path))
        finally:
            reader.close()
        timed = [(frame.stamp_ns - frames[0].stamp_ns, frame) for frame in frames]
        images = LogImages(*(tuple(t for t in timed if t[1].camera == name) for name in ("lower", "upper")))
        if min(len(images.lower), len(images.upper)) < 2:
            raise DriverError(f"{path}: {len(images.lower)} images of the lower and {len(images.upper)} of the "
                              "upper camera: give a log with two or more of each")
        return images

    @property
    def last_ns(self) -> int:
        """When the log's last image was taken."""
        return max(self.lower[-1][0], self.upper[-1][0])

    @property
    def pass_ns(self) -> int:
        """The time from one pass to the next: the log and one period, the same for both cameras."""
        return self.last_ns + max(1, self.last_ns // (max(len(self.lower), len(self.upper)) - 1))


def _bounded(frames: Iterator[Frame], path: Path) -> Iterator[Frame]:
    held = 0
    for frame in frames:
        held += len(frame.data)  # bytes, as LogReader gives them
        if held > MOST_BYTES:
            raise DriverError(f"{path}: more than {MOST_BYTES >> 20} MiB of images: cut the log into shorter ones")
        yield frame


class LogCamera:
    """One camera of a log, played forwards and backwards for as long as it is read.

    epoch_ns: when the log begins, CLOCK_MONOTONIC; both cameras of a log share it. pace: how many times as fast. once:
    ends with the log. A stamp is the moment at which the image was due; what was due before this camera was made is
    not shown.
    """

    def __init__(self, images: LogImages, camera: Camera, epoch_ns: int, *, pace: float = 1.0, once: bool = False
                 ) -> None:
        if not SLOWEST <= pace <= FASTEST:
            raise DriverError(f"the pace of a log is {pace:g}; give a number from {SLOWEST:g} to {FASTEST:g}; above 1 "
                              "is faster than it was recorded")
        self._images, self._frames = images, images.lower if camera == "lower" else images.upper
        self._epoch_ns, self._pace, self._once = epoch_ns, pace, once
        self._made_ns = time.monotonic_ns()
        self._closed = False
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """The frames when they are due, until closed; what nobody takes in time is left out and counted."""
        for seq, (due_ns, frame) in enumerate(self._schedule()):
            stamp_ns = self._epoch_ns + round(due_ns / self._pace)
            self._sleep_until(stamp_ns)
            if self._closed:
                break
            if time.monotonic_ns() <= stamp_ns + LATEST_NS:
                self.state.status = "streaming"
                self.state.frames += 1
                yield replace(frame, seq=seq, stamp_ns=stamp_ns)
            else:
                self.state.drops += stamp_ns > self._made_ns
        self.state.status = "closed"

    def close(self) -> None:
        """Ends frames(); may be called twice, from any thread."""
        self._closed = True

    def _schedule(self) -> Iterator[tuple[int, Frame]]:
        """Every frame with its time since the epoch at pace 1 [ns]; every second pass runs backwards."""
        last_ns, pass_ns = self._images.last_ns, self._images.pass_ns
        for start_ns in count(0, 2 * pass_ns):
            yield from ((start_ns + at_ns, frame) for at_ns, frame in self._frames)
            if self._once:
                return
            yield from ((start_ns + pass_ns + last_ns - at_ns, frame) for at_ns, frame in reversed(self._frames))

    def _sleep_until(self, due_ns: int) -> None:
        while not self._closed and (left_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, NAP_S))
