"""What the stages' messages become on the bus."""

from __future__ import annotations

import contextlib
import time
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
from rosbags.typesys import Stores, get_typestore

from calib import se3
from omnid.client import Robot
from omnid.core.klt import Wrapped
from omnid.messages import Odometry
from omnid.outputs.bus import BusSink, PanoramaSink
from omnid.outputs.encoded import Clouds, Encoder
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.decode import pose_from
from tests.omnid.buses import free_endpoint, wait_until

OFFSET_NS = 10**18
PICTURE = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (64, 160), np.uint8), (0, 0), 4)


def odometry(seq: int) -> Odometry:
    T = se3.transform(np.eye(3), [1.0, 0.0, 0.0])
    depth = cast("Any", SimpleNamespace(panoramas=SimpleNamespace(lower=Wrapped(PICTURE, 16))))
    return Odometry(seq, 10**9 * seq, T, np.eye(6), np.zeros(6), np.eye(6), "degraded", 3, 5, 9, depth)


def test_a_pose_comes_with_its_state_and_the_frames_of_ros() -> None:
    endpoint, came = free_endpoint(), {}
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        sink = BusSink(bus, Encoder(np.eye(4), Clouds(10), OFFSET_NS))
        robot.each(lambda topic, payload, note: came.update({topic: (payload, note)}))
        wait_until(lambda: sink.process(odometry(2)) is None and {"odom", "pose", "tf"} <= came.keys())
    pose = pose_from(*came["odom"])
    assert pose.stamp_ns == OFFSET_NS + 2 * 10**9 and pose.x_m == 1.0
    note = pose.note
    assert (note.seq, note.state, note.resets, note.inliers, note.tracks) == (2, "degraded", 3, 5, 9)
    assert 0 <= time.time_ns() - note.sent_ns < 60 * 10**9
    tf = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(came["tf"][0], "tf2_msgs/msg/TFMessage")
    frames = [(edge.header.frame_id, edge.child_frame_id) for edge in cast("Any", tf).transforms]
    assert frames == [("odom", "base_link"), ("base_link", "rig")]


def test_panoramas_are_sent_as_often_as_wanted() -> None:
    endpoint, came = free_endpoint(), []
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        robot.each(lambda topic, payload, _: came.append(payload))
        wait_until(lambda: PanoramaSink(bus, 0.5, OFFSET_NS).process(odometry(0)) is None and bool(came))
        time.sleep(0.2)
        came.clear()
        sink = PanoramaSink(bus, 0.5, OFFSET_NS)
        for seq in range(7):  # a second apart
            sink.process(odometry(seq))
        wait_until(lambda: len(came) >= 4)
    messages = [cast("Any", get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(payload,
                                                                             "sensor_msgs/msg/CompressedImage"))
                for payload in came]
    assert [message.header.stamp.sec for message in messages] == [10**9, 10**9 + 2, 10**9 + 4, 10**9 + 6]
    shown = cv2.imdecode(messages[0].data, cv2.IMREAD_GRAYSCALE)
    assert shown.shape == (64, 128) and np.abs(shown.astype(int) - PICTURE[:, 16:-16]).max() < 20
