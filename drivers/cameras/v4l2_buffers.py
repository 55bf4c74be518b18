"""The books on the buffers of a camera: which count, which are missing, and when each was taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from drivers.cameras import v4l2_ioctl as v4l2

Report = Callable[[int, str], None]  # how grave it is and one line; the numbers of syslog and journald (RFC 5424)
WARNING: Final = 4
NOTICE: Final = 5

_OLDEST_NS = 10 * 10**9  # no driver keeps a buffer for so long: such a stamp is of another clock


@dataclass(slots=True)
class CameraState:
    """How a camera is; its capturing thread alone writes, any thread may read one entry at a time."""

    status: Literal["opened", "streaming", "lost", "closed"] = "opened"
    mode: str = ""  # what is in force, such as "GREY 640x480 at 30 Hz"
    problem: str = ""  # why it is lost
    frames: int = 0  # given
    drops: int = 0  # taken by the camera, never seen here: gaps in the driver's sequence
    errors: int = 0  # buffers that the driver flagged, or that are too short
    restamped: int = 0  # stamps that could not be true, replaced by the arrival
    restarts: int = 0  # of the driver's sequence in the middle of a stream
    losses: int = 0
    reopens: int = 0


class BufferAccounting:
    """Judges buffers one by one; no clock and no device in it."""

    def __init__(self, name: str, state: CameraState, report: Report) -> None:
        self._name, self._state, self._report = name, state, report
        self._last_sequence: int | None = None
        self._last_stamp_ns = -1
        self._said: set[str] = set()

    def begin(self) -> None:
        """A stream starts anew, and so does its sequence."""
        self._last_sequence = None

    def admit(self, buffer: v4l2.V4l2Buffer, arrival_ns: int, least_bytes: int) -> int | None:
        """When the buffer's image was taken, ns of CLOCK_MONOTONIC, rising strictly; None where it has no image.

        arrival_ns: when it was taken from the driver, same clock. least_bytes: what a whole image has at least.
        """
        self._follow(buffer.sequence)
        if buffer.flags & v4l2.BUFFER_ERROR or buffer.bytesused < least_bytes:
            self._state.errors += 1
            return None
        if buffer.flags & v4l2.TIMESTAMP_MASK != v4l2.TIMESTAMP_MONOTONIC:
            self._say_once("clock", "its driver does not say which clock its stamps are of; taken for CLOCK_MONOTONIC")
        self._last_stamp_ns = self._stamp(buffer.stamp_ns, arrival_ns)
        return self._last_stamp_ns

    def _follow(self, sequence: int) -> None:
        """Counts what is missing since the last buffer; the sequence is of 32 bits and may start again."""
        if self._last_sequence is not None:
            step = (sequence - self._last_sequence) % 2**32
            if 0 < step < 2**31:
                self._state.drops += step - 1
            else:
                self._state.restarts += 1
        self._last_sequence = sequence

    def _stamp(self, stamp_ns: int, arrival_ns: int) -> int:
        """The driver's stamp if it can be true: after the last one, before the arrival and not long before."""
        if max(self._last_stamp_ns, arrival_ns - _OLDEST_NS) < stamp_ns <= arrival_ns:
            return stamp_ns
        self._state.restamped += 1
        self._say_once("stamp", f"a stamp lies {(stamp_ns - arrival_ns) / 1e6:.3f} ms after the arrival, or not after "
                       "the one before; such images are stamped with their arrival and counted")
        return max(arrival_ns, self._last_stamp_ns + 1)

    def _say_once(self, kind: str, text: str) -> None:
        if kind not in self._said:
            self._said.add(kind)
            self._report(WARNING, f"{self._name}: {text}")
