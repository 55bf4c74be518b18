"""CDR of the maps: clouds of points and occupancy grids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport import ros_types as ros

CLOUD_FIELDS = ("x", "y", "z", "confidence")
CLOUD_BLOCK = 4096  # points transformed at once: temporary arrays of a whole map would fragment the memory


def point_cloud_cdr(
    stamp_ns: int,
    frame: str,
    points: ArrayLike,
    confidence: ArrayLike,
    *,
    T_frame_points: NDArray[np.float64] | None = None,
) -> bytes:
    """Encode a sensor_msgs/msg/PointCloud2 of points (N, 3) [m] with confidence (N,): float32, 16 bytes per point.

    T_frame_points (4, 4) maps the points into `frame`; None where they are given in it.
    """
    return packed_cloud_cdr(stamp_ns, frame, CLOUD_FIELDS, _packed(points, confidence, T_frame_points))


def packed_cloud_cdr(stamp_ns: int, frame: str, names: Sequence[str], rows: NDArray[np.float32]) -> bytes:
    """Encode a sensor_msgs/msg/PointCloud2 of rows (N, F), little-endian float32, whose F fields have these names."""
    number = ros.sensor_msgs__msg__PointField.FLOAT32
    message = ros.sensor_msgs__msg__PointCloud2(
        header=codec.header_message(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=[ros.sensor_msgs__msg__PointField(name, 4 * i, number, 1) for i, name in enumerate(names)],
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=4 * len(names) * len(rows),
        data=rows.reshape(-1).view(np.uint8),
        is_dense=bool(np.isfinite(rows).all()),
    )
    return codec.message_cdr(message, codec.POINT_CLOUD_SCHEMA)


def _packed(points: ArrayLike, confidence: ArrayLike, T: NDArray[np.float64] | None) -> NDArray[np.float32]:
    """Return points, transformed in double precision, and confidence as (N, 4) little-endian float32."""
    points, confidence = np.asarray(points).reshape(-1, 3), np.asarray(confidence).reshape(-1)
    if len(points) != len(confidence):
        raise OmnidError(f"{len(confidence)} confidences for {len(points)} points: expected one for each point")
    packed = np.empty((len(points), 4), "<f4")
    packed[:, 3] = confidence
    for start in range(0, len(points), CLOUD_BLOCK):
        at = slice(start, start + CLOUD_BLOCK)
        packed[at, :3] = points[at] if T is None else se3.apply(T, points[at])
    return packed


def grid_cdr(stamp_ns: int, frame: str, cells: NDArray[np.int8], cell_m: float, corner: tuple[float, float]) -> bytes:
    """Encode a nav_msgs/msg/OccupancyGrid of cells (H, W), z = 0 in `frame`; corner: x, y of cell (0, 0), m."""
    height, width = cells.shape
    corner_pose = codec.pose_message(se3.transform(np.eye(3), (*corner, 0.0)))
    info = ros.nav_msgs__msg__MapMetaData(codec.time_message(stamp_ns), cell_m, width, height, corner_pose)
    message = ros.nav_msgs__msg__OccupancyGrid(codec.header_message(stamp_ns, frame), info, cells.reshape(-1))
    return codec.message_cdr(message, codec.GRID_SCHEMA)
