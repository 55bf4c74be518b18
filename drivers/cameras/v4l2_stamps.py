"""Validation of the capture times that the kernel stamps on buffers."""

from __future__ import annotations

import logging
from collections import deque
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraState
from drivers.events import EventCallback

_RECENT: Final = 16  # valid stamps by which the usual delay is judged, the least of theirs: half a second at 30 Hz
_MOST_JITTER_NS: Final = 500_000_000  # no delay of a camera that delivers images varies by more
_MAX_AGE_NS: Final = 10 * 10**9  # no driver keeps a buffer for longer; an older stamp is from another clock


class StampValidator:
    """Accept plausible stamps, replace the others by the time of arrival less the usual delay; reads no clock.

    Each kind of fault is reported once by `on_event`, with `name` in front.
    """

    def __init__(self, name: str, state: CameraState, on_event: EventCallback) -> None:
        self._name, self._state, self._on_event = name, state, on_event
        self._last_valid_ns = self._last_ns = -1  # stamps of the kernel and those that were returned
        self._delays_ns: deque[int] = deque(maxlen=_RECENT)  # from valid stamps to their arrivals
        self._reported: set[str] = set()

    def validate(self, buffer: v4l2.V4l2Buffer, arrival_ns: int) -> int:
        """Return the capture time of a buffer [ns of CLOCK_MONOTONIC], strictly increasing from call to call.

        arrival_ns: time at which the buffer was taken from the driver, same clock. A stamp is valid if it is later
        than the last valid one and at most 10 s before the arrival. v4l2loopback does not declare its clock: its stamps
        are taken for CLOCK_MONOTONIC, with one warning.
        """
        if buffer.flags & v4l2.TIMESTAMP_MASK != v4l2.TIMESTAMP_MONOTONIC:
            self._report_once("clock", "its driver does not declare a clock for its stamps; CLOCK_MONOTONIC is assumed")
        stamp_ns = buffer.stamp_ns
        delay_ns, usual_ns = arrival_ns - stamp_ns, min(self._delays_ns, default=0)
        # A clock that fell back is later than its own last stamps again some time, but not than those returned since.
        fell_back = stamp_ns <= self._last_ns and delay_ns > usual_ns + _MOST_JITTER_NS
        if max(self._last_valid_ns, arrival_ns - _MAX_AGE_NS) < stamp_ns <= arrival_ns and not fell_back:
            self._last_valid_ns = stamp_ns
            self._delays_ns.append(delay_ns)
        else:
            self._state.restamped += 1
            self._report_once(
                "stamp",
                f"a stamp is {(stamp_ns - arrival_ns) / 1e6:.3f} ms after the arrival, or not after the stamp before; "
                "the time of arrival, less the usual delay, is used for such images, which are counted",
            )
            stamp_ns = arrival_ns - usual_ns
        self._last_ns = max(stamp_ns, self._last_ns + 1)
        return self._last_ns

    def _report_once(self, kind: str, text: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._on_event(logging.WARNING, f"{self._name}: {text}")
