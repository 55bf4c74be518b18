"""CDR of the messages of the navigation."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from omnid.transport import codec
from omnid.transport.navigation_codec import driven_path_cdr

STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_the_bytes_are_those_of_rosbags(count: int) -> None:
    poses = np.random.default_rng(count).normal(size=(count, 7))
    stamps_ns = 10**18 + np.arange(count) * 123_456_789
    entries = [
        ros.geometry_msgs__msg__PoseStamped(
            codec.header_message(int(t), "odom"),
            ros.geometry_msgs__msg__Pose(
                ros.geometry_msgs__msg__Point(*map(float, p[:3])),
                ros.geometry_msgs__msg__Quaternion(*map(float, p[3:])),
            ),
        )
        for t, p in zip(stamps_ns, poses, strict=True)
    ]
    message = ros.nav_msgs__msg__Path(codec.header_message(5 * 10**17 + 7, "odom"), entries)
    expected = bytes(STORE.serialize_cdr(message, "nav_msgs/msg/Path"))
    assert driven_path_cdr(5 * 10**17 + 7, stamps_ns, poses) == expected
