"""Moving obstacles as PointCloud2, compared with the bytes that rosbags writes."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.moving_codec import FIELDS, moving_cdr

STORE = get_typestore(Stores.ROS2_HUMBLE)
STAMP_NS = 1_700_000_123_987_654_321
PERSON = MovingObstacle(1.5, -0.25, 0.0, 0.75, np.diag([0.01, 0.04, 0.25, 0.09]), 0.25)


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("frame", ["odom", "o", "odo"])
def test_the_bytes_are_those_of_ros(count: int, frame: str) -> None:
    points = np.array([[1.5, -0.25, 0, 0, 0.75, 0.25, 0.2, 0.5]] * count, "<f4").reshape(count, 8)
    header = ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(*divmod(STAMP_NS, 10**9)), frame)
    fields = [ros.sensor_msgs__msg__PointField(name, 4 * i, 7, 1) for i, name in enumerate(FIELDS)]
    cloud = ros.sensor_msgs__msg__PointCloud2(
        header, 1, count, fields, False, 32, 32 * count, points.reshape(-1).view(np.uint8), True
    )
    expected = bytes(STORE.serialize_cdr(cloud, codec.POINT_CLOUD_SCHEMA))
    assert moving_cdr(STAMP_NS, frame, [PERSON] * count) == expected


def test_a_stamp_must_fit() -> None:
    with pytest.raises(OmnidError, match="stamp"):
        moving_cdr(2**31 * 10**9, "odom", [])
