"""The driven path: its bytes, its bounds, and how often it is given."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calib import se3
from omnid.messages import OdometryUpdate
from omnid.sinks.driven_path import MOST_POSES, DrivenPath
from omnid.sinks.encoder import Encoder, MapEncoding

STORE = get_typestore(Stores.ROS2_HUMBLE)
T_BASE_RIG = se3.exp([0.2, -0.1, 0.5, 0.1, -0.2, 1.0])


def pose(seq: int, T_odom_base: np.ndarray, period_ns: int = 10**8) -> OdometryUpdate:
    """Return the pose of a rig whose base is given."""
    T = se3.inverse(T_BASE_RIG) @ T_odom_base @ T_BASE_RIG
    return OdometryUpdate(seq, period_ns * seq, T, np.eye(6), np.zeros(6), np.eye(6), "tracking", 0, 9, 9, None)  # type: ignore[arg-type]  # the depth is not used


def ahead(x_m: float, heading_rad: float = 0.0) -> np.ndarray:
    return se3.transform(se3.rotation_exp([0.0, 0.0, heading_rad]), [x_m, 0.0, 0.0])


def driven_path(s_per_pose: float = 0.0) -> DrivenPath:
    return DrivenPath(Encoder(T_BASE_RIG, MapEncoding(1), 10**18), s_per_pose)


def decoded(payload: bytes) -> Any:
    return cast("Any", STORE.deserialize_cdr(payload, "nav_msgs/msg/Path"))


def test_the_path_is_that_of_the_base_and_comes_each_second_in_which_it_has_grown() -> None:
    path = driven_path()
    drive = [ahead(min(seq, 30) * 0.026, 0.1) for seq in range(100)]  # 2.6 cm a pose, 10 poses a second; stands at 3 s
    given = [message for seq, T in enumerate(drive) for message in path(pose(seq, T))]
    assert [(message.topic, message.schema) for message in given] == [("path", "nav_msgs/msg/Path")] * 4
    last = decoded(given[-1].payload)
    assert last.header.frame_id == "odom"
    np.testing.assert_allclose([p.pose.position.x for p in last.poses], 0.052 * np.arange(16), atol=1e-9)
    assert {round(2 * math.asin(p.pose.orientation.z), 9) for p in last.poses} == {0.1}
    assert [p.header.stamp.nanosec // 10**8 for p in last.poses[:6]] == [0, 2, 4, 6, 8, 0]
    assert list(path.finish()) == [], "nothing new since then"


def test_a_turn_in_place_is_in_the_path() -> None:
    path, given = driven_path(), []
    for seq in range(95):
        given += path(pose(seq, ahead(0.0, math.radians(seq))))
    given += path.finish()
    assert len(decoded(given[-1].payload).poses) == 1 + 94 // 11, "10 degrees are passed at the 11th"


def test_a_long_path_is_thinned_evenly() -> None:
    path, given = driven_path(0.02), []
    for seq in range(4 * MOST_POSES):
        given += path(pose(seq, ahead(0.06 * seq), 5 * 10**7))
    given += path.finish()
    x_m = np.array([p.pose.position.x for p in decoded(given[-1].payload).poses])
    assert MOST_POSES / 2 <= len(x_m) <= MOST_POSES and x_m[-1] > 0.99 * 240
    assert np.diff(x_m).max() < 3 * np.diff(x_m).min() < 1.0 and x_m[0] < 1.0
    assert sum(len(message.payload) for message in given) < 4000 * 200 * 1.1 + 80_000, "4 kB/s, and the last one"
