"""Moving obstacles as sensor_msgs/msg/PointCloud2, a point each; an obstacle ring without any has a message, too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.transport.map_codec import packed_cloud_cdr

# m, m/s; sigma and sigma_v: of position and velocity along the axis in which they are largest.
FIELDS: Final = ("x", "y", "z", "vx", "vy", "radius", "sigma", "sigma_v")


def moving_cdr(stamp_ns: int, frame: str, moving: Sequence[MovingObstacle]) -> bytes:
    """Encode moving obstacles in a frame. Raise OmnidError where the stamp does not fit a ROS time."""
    rows = [[one.x_m, one.y_m, 0.0, one.vx_mps, one.vy_mps, one.radius_m, *_sigmas(one)] for one in moving]
    return packed_cloud_cdr(stamp_ns, frame, FIELDS, np.array(rows, "<f4").reshape(-1, len(FIELDS)))


def _sigmas(one: MovingObstacle) -> tuple[float, float]:
    position, velocity = (one.covariance[at, at] for at in (slice(0, 2), slice(2, 4)))
    largest = [float(np.sqrt(max(0.0, np.linalg.eigvalsh(part)[-1]))) for part in (position, velocity)]
    return largest[0], largest[1]
