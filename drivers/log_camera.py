"""A recorded log in the place of a live camera: real pictures, at their pace or another, stamped as they are given."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from drivers.errors import DriverError
from drivers.frame import Camera, Frame
from drivers.mcap_reader import LogReader
from drivers.v4l2_ledger import CameraState

MOST_BYTES = 1 << 30
NAP_S = 0.02
LATEST_NS = 100_000_000  # what comes later than that is left out, as by a camera whose buffers are full


@dataclass(frozen=True, slots=True)
class Pictures:
    """The frames of both cameras held in memory, each with its time since the first [ns]."""

    lower: tuple[tuple[int, Frame], ...]
    upper: tuple[tuple[int, Frame], ...]

    @staticmethod
    def of(path: Path, lower: str | None = None, upper: str | None = None) -> Pictures:
        """The pictures of a log; DriverError where it is none or holds more than MOST_BYTES."""
        reader = LogReader(path, lower, upper)
        try:
            frames = list(_bounded(reader.frames(), path))
        finally:
            reader.close()
        if not frames:
            raise DriverError(f"{path}: no pictures in this log: give one with the frames of two cameras")
        first_ns = frames[0].stamp_ns
        timed = [(frame.stamp_ns - first_ns, frame) for frame in frames]
        return Pictures(tuple(t for t in timed if t[1].camera == "lower"),
                        tuple(t for t in timed if t[1].camera == "upper"))


def _bounded(frames: Iterator[Frame], path: Path) -> Iterator[Frame]:
    held = 0
    for frame in frames:
        held += len(frame.data)  # bytes, as LogReader gives them
        if held > MOST_BYTES:
            raise DriverError(f"{path}: more than {MOST_BYTES >> 20} MiB of pictures: cut the log into shorter ones")
        yield frame


class LogCamera:
    """One camera of a log, played forwards and backwards for as long as it is read.

    epoch_ns: when the log begins, CLOCK_MONOTONIC; both cameras of a log share it. pace: how many times as fast. once:
    ends with the log. A stamp is the moment at which the picture was due.
    """

    def __init__(self, pictures: Pictures, camera: Camera, epoch_ns: int, *, pace: float = 1.0, once: bool = False
                 ) -> None:
        self._frames = pictures.lower if camera == "lower" else pictures.upper
        self._last_ns = max(at for both in (pictures.lower, pictures.upper) for at, _ in both[-1:])
        self._epoch_ns, self._pace, self._once = epoch_ns, pace, once
        self._closed = False
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """The frames when they are due, until closed; what nobody takes in time is left out and counted."""
        for seq, (due_ns, frame) in enumerate(self._schedule()):
            stamp_ns = self._epoch_ns + round(due_ns / self._pace)
            self._sleep_until(stamp_ns)
            if self._closed:
                return
            if time.monotonic_ns() > stamp_ns + LATEST_NS:
                self.state.drops += 1
            else:
                self.state.status = "streaming"
                self.state.frames += 1
                yield replace(frame, seq=seq, stamp_ns=stamp_ns)

    def close(self) -> None:
        """Ends frames(); may be called twice, from any thread."""
        self._closed = True

    def _schedule(self) -> Iterator[tuple[int, Frame]]:
        """Every frame with its time since the epoch at pace 1 [ns]; every second pass runs backwards."""
        last_ns = self._last_ns
        pass_ns = last_ns + last_ns // max(1, len(self._frames) - 1)
        for start_ns in count(0, max(1, 2 * pass_ns)) if self._frames else ():
            yield from ((start_ns + at, frame) for at, frame in self._frames)
            if self._once:
                return
            yield from ((start_ns + pass_ns + last_ns - at, frame) for at, frame in reversed(self._frames))

    def _sleep_until(self, due_ns: int) -> None:
        while not self._closed and (left_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, NAP_S))
