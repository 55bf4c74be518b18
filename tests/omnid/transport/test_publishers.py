"""Publishers of the bus: all topics are announced to ROS 2, and late subscribers receive what is kept."""

from __future__ import annotations

import contextlib
import re

import pytest
from zenoh import ext

from omnid.client import Robot, Unreachable, subscribe
from omnid.errors import OmnidError
from omnid.transport import codec, ros2
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.topics import PUBLISHED
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.omnid.transport.ros2_fixtures import COMMANDS, TOPICS, client, tokens
from tests.waiting import wait_until


def test_all_topics_are_announced_to_rmw_zenoh() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh", ros2_domain=3))) as bus:
        bus.subscribe_commands(lambda *_: None, COMMANDS)
        found = [token.split("/") for token in tokens(endpoint, "@ros2_lv/3/**", len(TOPICS) + 1)]
    announced = {parts[9].replace("%", "/"): (parts[5], parts[10]) for parts in found if parts[5] != "NN"}
    assert announced == {
        topic: ("MS" if "/cmd/" in topic else "MP", ros2.dds_type(schema)) for topic, schema in TOPICS.items()
    }
    assert len({parts[4] for parts in found}) == len(TOPICS) + 1, "entity numbers are unique"
    assert [parts[5:] for parts in found if parts[5] == "NN"] == [["NN", "%", "%", "omnid"]]


def test_late_subscribers_of_ros_receive_the_static_frames() -> None:
    """A subscriber that is transient local in ROS 2 is an AdvancedSubscriber with history of zenoh."""
    endpoint, key = free_endpoint(), ros2.data_key(0, "/tf_static", codec.TRANSFORM_SCHEMA)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh"))) as bus:
        for payload in (b"before a refinement", b"frames"):
            bus.publish("/tf_static", payload)
        with client(endpoint) as session:
            history, came = ext.HistoryConfig(detect_late_publishers=True, max_samples=1), list[bytes]()
            subscriber = ext.declare_advanced_subscriber(
                session, key, lambda sample: came.append(sample.payload.to_bytes()), history=history
            )
            wait_until(lambda: bool(came))
            bus.publish("/tf_static", b"refined")
            wait_until(lambda: len(came) == 2)
            subscriber.undeclare()
        publishers = tokens(endpoint, "@ros2_lv/**", len(PUBLISHED) - 1)  # /clock is that of a simulation
    kept = {
        topic
        for topic in ("tf_static", "map", "tf", "map_pose")
        for token in publishers
        if re.search(f"[%/]{topic}/", token) and token.endswith("/" + ros2.TRANSIENT_LOCAL)
    }
    assert not any("clock" in token for token in publishers)
    assert came == [b"frames", b"refined"] and kept == {"tf_static", "map"}


def test_late_subscribers_receive_the_newest_message_at_once() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        for i in range(3):
            bus.publish("odom", odometry(i), PoseAttachment(i, "degraded", 4).to_bytes())
        bus.serve("rig", "name = 'rig'")
        with subscribe(connect=(endpoint,)) as poses, Robot(connect=(endpoint,)) as robot:
            pose = poses.newest()
            assert pose is not None and pose.stamp_ns == 10**9 + 2
            assert (pose.state, pose.attachment.seq, pose.attachment.resets) == ("degraded", 2, 4)
            assert robot.query("rig") == "name = 'rig'" and robot.query("nothing") == "" and robot.alive
    with pytest.raises(Unreachable):
        Robot(connect=(endpoint,))


def test_publish_refuses_unknown_topics_and_a_closed_bus() -> None:
    bus = Bus(BusConfig(listen=()))
    with pytest.raises(OmnidError, match="key"):
        bus.publish("a/*", b"")
    bus.close()
    bus.close()
    with pytest.raises(OmnidError, match="cannot publish"):
        bus.publish("odom", b"")
