"""Playback of a log at the rate at which it was recorded."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

from drivers.frame import Frame

_POLL_S = 0.05  # longest sleep, so that `wake` takes effect soon


class PlaybackClock:
    """Delays frames to the intervals of their stamps; `wake` ends all waiting."""

    def __init__(self) -> None:
        self._awake = False

    def wake(self) -> None:
        """End all waiting: the rest of the frames comes without delay."""
        self._awake = True

    def frames(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, each when its stamp is due; the first one at once."""
        offset_ns: int | None = None
        for frame in frames:
            if offset_ns is None:
                offset_ns = time.monotonic_ns() - frame.stamp_ns
            self._wait(frame.stamp_ns + offset_ns)
            yield frame

    def _wait(self, until_ns: int) -> None:
        while not self._awake and (left_s := (until_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, _POLL_S))
