"""Which ROS 2 messages are made of an update."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calib import se3
from drivers.motor import VelocityCommand
from omnid.core.mapping.voxel_map import MapPoints
from omnid.messages import MapUpdate
from omnid.sinks.encoder import Encoder, Outgoing, static_frames
from tests.simulation import make_rig

OFFSET_NS = 10**18


def unix_ns(stamp_ns: int) -> int:
    return stamp_ns + OFFSET_NS


STORE = get_typestore(Stores.ROS2_HUMBLE)


def decoded(message: Outgoing, points: int = 10) -> list[tuple[str, Any]]:
    """Return topics and messages of ROS 2."""
    encode = Encoder(np.eye(4), points, unix_ns)
    return [(sent.topic, STORE.deserialize_cdr(sent.payload, sent.schema)) for sent in encode(message)]


def test_a_command_is_in_unix_time_and_in_the_frame_of_the_base() -> None:
    [(topic, twist)] = decoded(VelocityCommand(5 * 10**9, 0.25, 0.0, -0.5))
    assert (topic, twist.header.frame_id, twist.header.stamp.sec) == ("drive", "base_link", 10**9 + 5)
    assert (twist.twist.linear.x, twist.twist.angular.z) == (0.25, -0.5)


def test_a_cloud_has_the_most_confident_points_in_their_order() -> None:
    xyz = np.arange(12, dtype=np.float32).reshape(4, 3)
    ages = np.zeros(4, np.int32)
    points = MapPoints(xyz, np.array([0.9, 0.1, 0.2, 0.8], np.float32), ages, ages)
    [(topic, cloud)] = decoded(MapUpdate(1, 1, points, np.zeros((0, 2))), points=2)
    shown = np.frombuffer(cloud.data.tobytes(), np.float32).reshape(cloud.width, -1)[:, :3]
    assert topic == "cloud" and shown.tolist() == xyz[[0, 3]].tolist()


def test_the_static_frames_lead_from_the_base_to_the_cameras() -> None:
    rig = replace(make_rig(size=256), T_base_rig=se3.exp([0.1, 0.0, 0.4, 0.0, 0.1, 0.5]))
    sent = static_frames(Encoder(rig.T_base_rig, 1, unix_ns, rig), 5)
    found = {}
    for edge in cast("Any", STORE.deserialize_cdr(sent.payload, sent.schema)).transforms:
        t, q = edge.transform.translation, edge.transform.rotation
        T = se3.transform(se3.rotation([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
        found[edge.header.frame_id, edge.child_frame_id] = T
    assert sent.topic == "/tf_static"
    assert list(found) == [("base_link", "rig"), ("rig", "lower"), ("rig", "upper")]
    np.testing.assert_allclose(found["base_link", "rig"], rig.T_base_rig, atol=1e-12)
    np.testing.assert_allclose(found["rig", "upper"] @ rig.upper.T_cam_rig, np.eye(4), atol=1e-9)
