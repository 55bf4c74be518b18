"""Obstacle ring as sensor_msgs/msg/LaserScan, which nav2 and RViz read; little-endian CDR (OMG RTPS 2.2, 10.2).

As REP 117 says: inf is free up to range_max, NaN is unknown. intensities are the standard deviations of the ranges, m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from struct import pack
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.errors import OmnidError
from omnid.transport import ros_types as ros
from omnid.transport.codec import message_from_cdr, ros_time, unchecked_stamp_ns

SCAN_SCHEMA: Final = "sensor_msgs/msg/LaserScan"
MOST_RANGES: Final = 100_000
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Content of a LaserScan."""

    stamp_ns: int
    frame: str
    azimuths_rad: NDArray[np.floating]  # (N,) counter-clockwise from x
    ranges_m: NDArray[np.floating]  # (N,) inf: free up to max_range_m, NaN: unknown
    sigma_m: NDArray[np.floating]  # (N,) NaN: unknown; empty in scans of other senders
    max_range_m: float


def scan_cdr(stamp_ns: int, frame: str, ranges_m: Floats, sigma_m: Floats, limits_m: tuple[float, float]) -> bytes:
    """Encode a scan of sectors (N,) that divide a full turn from azimuth -pi on; limits_m: least and longest range.

    Raise OmnidError where the stamp does not fit a ROS time.
    """
    name = frame.encode() + b"\0"
    head = pack("<iII", *ros_time(stamp_ns), len(name)) + name
    step = 2 * math.pi / len(ranges_m)
    numbers = pack("<7f", step / 2 - math.pi, math.pi - step / 2, step, 0.0, 0.0, *limits_m)
    arrays = [
        part
        for values in (ranges_m, sigma_m)
        for part in (pack("<I", len(values)), np.ascontiguousarray(values, "<f4").tobytes())
    ]
    return b"".join([b"\0\1\0\0", head, bytes(-len(head) % 4), numbers, *arrays])


def decode_scan(payload: bytes, _: bytes = b"") -> Scan:
    """Decode a LaserScan. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, SCAN_SCHEMA)
    assert isinstance(message, ros.sensor_msgs__msg__LaserScan)
    count = len(message.ranges)
    if count > MOST_RANGES or not (math.isfinite(message.angle_min) and math.isfinite(message.angle_increment)):
        raise OmnidError(
            f"a scan of {count} ranges from {message.angle_min} rad by {message.angle_increment} rad was "
            f"found; expected finite angles and at most {MOST_RANGES} ranges"
        )
    azimuths = message.angle_min + message.angle_increment * np.arange(count)
    stamp_ns = unchecked_stamp_ns(message.header.stamp)
    return Scan(
        stamp_ns, message.header.frame_id, azimuths, message.ranges, message.intensities, float(message.range_max)
    )
