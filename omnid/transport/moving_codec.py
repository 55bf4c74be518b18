"""Moving obstacles as sensor_msgs/msg/PointCloud2, a point each, one message for each obstacle ring, also without any.

Little-endian CDR (OMG RTPS 2.2, 10.2): numbers are aligned to their size, counted from behind the 4 bytes of the head.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import pack
from typing import Final

import numpy as np

from omnid.core.obstacles.moving_obstacle import MovingObstacle
from omnid.errors import OmnidError
from omnid.transport.codec import MAX_SECONDS, NS_PER_S

# m, m/s; sigma and sigma_v: of position and velocity along the axis in which they are largest.
FIELDS: Final = ("x", "y", "z", "vx", "vy", "radius", "sigma", "sigma_v")
FLOAT32: Final = 7  # sensor_msgs/msg/PointField


def moving_cdr(stamp_ns: int, frame: str, moving: Sequence[MovingObstacle]) -> bytes:
    """Encode moving obstacles in a frame. Raise OmnidError where the stamp does not fit a ROS time."""
    seconds, nanoseconds = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= seconds <= MAX_SECONDS:
        raise OmnidError(f"stamp {stamp_ns} ns does not fit a ROS time (1970 to 2038); give nanoseconds of Unix time")
    rows = [[one.x_m, one.y_m, 0.0, one.vx_mps, one.vy_mps, one.radius_m, *_sigmas(one)] for one in moving]
    step = 4 * len(FIELDS)
    body = pack("<iI", seconds, nanoseconds) + _string(frame)
    body = _aligned(body) + pack("<III", 1, len(rows), len(FIELDS))
    for number, name in enumerate(FIELDS):
        body = _aligned(_aligned(body) + _string(name)) + pack("<IB", 4 * number, FLOAT32)
        body = _aligned(body) + pack("<I", 1)
    body = _aligned(body + b"\0") + pack("<III", step, step * len(rows), step * len(rows))
    return b"\0\1\0\0" + body + np.array(rows, "<f4").tobytes() + b"\1"


def _sigmas(one: MovingObstacle) -> tuple[float, float]:
    position, velocity = (one.covariance[at, at] for at in (slice(0, 2), slice(2, 4)))
    largest = [float(np.sqrt(max(0.0, np.linalg.eigvalsh(part)[-1]))) for part in (position, velocity)]
    return largest[0], largest[1]


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return pack("<I", len(data)) + data


def _aligned(block: bytes) -> bytes:
    return block + bytes(-len(block) % 4)
