"""Sorts the frames of two cameras by their stamps within a bounded window."""

from __future__ import annotations

from collections import Counter

from drivers.logs.reorder_buffer import ReorderBuffer
from drivers.logs.ros_image import RosImage


def test_limits_the_bytes_of_waiting_frames() -> None:
    data = memoryview(bytes(64 * 2**20))
    order = ReorderBuffer(32, Counter())
    given = [len(list(order.push("lower", RosImage(stamp, "mono8", data)))) for stamp in range(1, 8)]
    assert given == [0, 0, 0, 0, 1, 1, 1]
