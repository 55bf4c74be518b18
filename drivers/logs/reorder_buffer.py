"""Frames of two cameras put into the order of their stamps, within a bounded window."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from drivers.frame import Camera, Frame
from drivers.logs.ros_image import RosImage

MAX_HELD_BYTES = 256 * 2**20


class _Held(NamedTuple):
    """Sorts by stamp, then lower before upper, then by arrival, so that nothing depends on chance."""

    stamp_ns: int
    camera: Camera
    arrival: int
    image: RosImage


class ReorderBuffer:
    """Holds up to `window` frames and 256 MiB, and gives the oldest when there are more.

    A frame older than one already given is dropped and counted as 'late', a second one with the stamp of its camera's
    last as 'duplicate'; 'lower' and 'upper' count what was given.
    """

    def __init__(self, window: int, counts: Counter[str]) -> None:
        self._window = window
        self._counts = counts
        self._heap: list[_Held] = []
        self._held_bytes = 0
        self._arrivals = 0
        self._newest_ns = 0
        self._last_ns: dict[Camera, int] = {}

    def push(self, camera: Camera, image: RosImage) -> Iterator[Frame]:
        """Takes a frame, whose data must not change any more; gives those that are due."""
        heapq.heappush(self._heap, _Held(image.stamp_ns, camera, self._arrivals, image))
        self._arrivals += 1
        self._held_bytes += len(image.data)
        while self._heap and (len(self._heap) > self._window or self._held_bytes > MAX_HELD_BYTES):
            yield from self._pop()

    def drain(self) -> Iterator[Frame]:
        """Gives all that is left."""
        while self._heap:
            yield from self._pop()

    def _pop(self) -> Iterator[Frame]:
        held = heapq.heappop(self._heap)
        self._held_bytes -= len(held.image.data)
        if self._last_ns.get(held.camera) == held.stamp_ns:
            self._counts["duplicate"] += 1
        elif held.stamp_ns < self._newest_ns:
            self._counts["late"] += 1
        else:
            self._newest_ns = self._last_ns[held.camera] = held.stamp_ns
            yield self._frame(held)

    def _frame(self, held: _Held) -> Frame:
        seq, image = self._counts[held.camera], held.image
        self._counts[held.camera] += 1
        return Frame(
            seq,
            held.stamp_ns,
            held.camera,
            image.encoding,
            image.data,
            image.width,
            image.height,
            image.step,
            image.bigendian,
        )
