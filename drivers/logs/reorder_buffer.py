"""Sorts the frames of two cameras by their stamps within a bounded window."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from drivers.frame import Camera, Frame
from drivers.logs.ros_image import RosImage

MAX_HELD_BYTES = 256 * 2**20


class _WaitingImage(NamedTuple):
    """An image in the window; sorts by stamp, then lower before upper, then by arrival, so the order is unique."""

    stamp_ns: int
    camera: Camera
    arrival: int
    image: RosImage


class ReorderBuffer:
    """Holds up to `window` frames and 256 MiB, and yields the oldest when there are more.

    A frame older than one already delivered is dropped and counted as 'late'; one with the same stamp as the frame
    before of its camera as 'duplicate'; 'lower' and 'upper' count the delivered frames.
    """

    def __init__(self, window: int, counts: Counter[str]) -> None:
        self._window = window
        self._counts = counts
        self._heap: list[_WaitingImage] = []
        self._held_bytes = 0
        self._arrivals = 0
        self._newest_ns = 0
        self._last_ns: dict[Camera, int] = {}

    def push(self, camera: Camera, image: RosImage) -> Iterator[Frame]:
        """Add an image, whose data must not change afterwards; yield the frames that are due."""
        heapq.heappush(self._heap, _WaitingImage(image.stamp_ns, camera, self._arrivals, image))
        self._arrivals += 1
        self._held_bytes += len(image.data)
        while self._heap and (len(self._heap) > self._window or self._held_bytes > MAX_HELD_BYTES):
            yield from self._pop()

    def drain(self) -> Iterator[Frame]:
        """Yield all remaining frames."""
        while self._heap:
            yield from self._pop()

    def _pop(self) -> Iterator[Frame]:
        oldest = heapq.heappop(self._heap)
        self._held_bytes -= len(oldest.image.data)
        if self._last_ns.get(oldest.camera) == oldest.stamp_ns:
            self._counts["duplicate"] += 1
        elif oldest.stamp_ns < self._newest_ns:
            self._counts["late"] += 1
        else:
            self._newest_ns = self._last_ns[oldest.camera] = oldest.stamp_ns
            self._counts[oldest.camera] += 1
            yield oldest.image.frame(oldest.camera, self._counts[oldest.camera] - 1)
