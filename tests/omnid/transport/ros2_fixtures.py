"""Sessions of ROS 2 on the bus, and the tokens by which it finds topics."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator

import zenoh

from omnid.transport.topics import command_topics
from tests.waiting import wait_until


@contextlib.contextmanager
def client(endpoint: str, mode: str = "client") -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    for key, value in (("mode", mode), ("connect/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def tokens(endpoint: str, pattern: str, expected: int) -> set[str]:
    found: set[str] = set()
    with client(endpoint) as session:

        def complete() -> bool:
            found.update(str(reply.ok.key_expr) for reply in session.liveliness().get(pattern) if reply.ok)
            return len(found) >= expected

        wait_until(complete)
    return found


TOPICS = {
    "/omnid/cloud": "sensor_msgs/msg/PointCloud2",
    "/omnid/drive": "geometry_msgs/msg/TwistStamped",
    "/omnid/map": "nav_msgs/msg/OccupancyGrid",
    "/omnid/moving": "sensor_msgs/msg/PointCloud2",
    "/omnid/scan": "sensor_msgs/msg/LaserScan",
    "/omnid/odom": "nav_msgs/msg/Odometry",
    "/omnid/panorama": "sensor_msgs/msg/CompressedImage",
    "/omnid/map_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/omnid/pose": "geometry_msgs/msg/PoseStamped",
    "/omnid/status": "diagnostic_msgs/msg/DiagnosticArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/omnid/cmd/twist": "geometry_msgs/msg/TwistStamped",
    "/omnid/cmd/heading": "geometry_msgs/msg/Vector3Stamped",
    "/omnid/cmd/stop": "std_msgs/msg/Empty",
    "/omnid/cmd/arm": "std_msgs/msg/Header",
    "/omnid/cmd/planner/twist": "geometry_msgs/msg/TwistStamped",
    "/omnid/cmd/planner/heading": "geometry_msgs/msg/Vector3Stamped",
    "/omnid/navigation": "diagnostic_msgs/msg/DiagnosticArray",
    "/omnid/plan": "nav_msgs/msg/Path",
    "/omnid/cmd/goal": "geometry_msgs/msg/PoseStamped",
    "/omnid/cmd/path": "nav_msgs/msg/Path",
    "/omnid/cmd/navigation": "std_msgs/msg/String",
    "/omnid/cmd/route": "std_msgs/msg/String",
    "/omnid/cmd/map": "std_msgs/msg/String",
    "/omnid/cmd/bumper": "std_msgs/msg/Bool",
    "/omnid/cmd/cliff": "std_msgs/msg/Bool",
    "/omnid/wheel_odom": "nav_msgs/msg/Odometry",
    "/omnid/imu": "sensor_msgs/msg/Imu",
    "/omnid/cmd/wheel_odom": "nav_msgs/msg/Odometry",
    "/omnid/cmd/imu": "sensor_msgs/msg/Imu",
    "/omnid/cmd/joint_states": "sensor_msgs/msg/JointState",
}


COMMANDS = command_topics(("planner",))
