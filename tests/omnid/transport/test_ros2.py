"""The bus as ROS 2 sees it, byte by byte: rmw_zenoh."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import subprocess
import time
from pathlib import Path

import pytest
import zenoh
from zenoh import ext

from omnid.client import Pose, Robot
from omnid.transport import codec, ros2
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.status_names import BUS, entry
from omnid.transport.topics import PUBLISHED, Request, command_topics, ros_name
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, odometry, script, session
from tests.waiting import wait_until

ODOMETRY_KEY = (
    "0/omnid/odom/nav_msgs::msg::dds_::Odometry_/"
    "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
)
HASHES = {  # as published by ROS 2's own type description service, first digits
    "std_msgs/msg/String": "df668c74",
    "nav_msgs/msg/Odometry": "3cc97dc7",
    "geometry_msgs/msg/PoseStamped": "10f3786d",
    "sensor_msgs/msg/PointCloud2": "9198cabf",
    "tf2_msgs/msg/TFMessage": "e369d0f0",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36ef",
    "sensor_msgs/msg/CompressedImage": "15640771",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f",
}
COMMANDS = command_topics(("planner",))
PACE_S = 0.01  # between messages, so that a reader which is slow for a moment has them all


@pytest.mark.parametrize("schema", HASHES)
def test_type_hashes_are_those_of_ros(schema: str) -> None:
    assert ros2.type_hash(schema).startswith(f"RIHS01_{HASHES[schema]}") and len(ros2.type_hash(schema)) == 71


def test_the_attachment_equals_that_of_zenohs_serializer() -> None:
    gid = bytes(range(16))
    made = ros2.attachment(7, 1_700_000_000_123_456_789, gid)
    assert len(made) == 33
    assert made == bytes(ext.z_serialize((ext.Int64(7), ext.Int64(1_700_000_000_123_456_789), gid)))
    assert made.hex() == "0700000000000000" + struct.pack("<q", 1_700_000_000_123_456_789).hex() + "10" + gid.hex()


def test_rmw_zenoh_receives_the_same_message_with_its_attachment() -> None:
    endpoint, gids, numbers = free_endpoint(), set(), []
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh"))) as bus,
        session(mode="client", connect__endpoints=[endpoint]) as node,
    ):
        # A full FIFO that is not read any longer blocks the session, and its close with it.
        samples = node.declare_subscriber(ODOMETRY_KEY, zenoh.handlers.RingChannel(100))
        while len(numbers) < 3:
            bus.publish("odom", odometry(1), b'{"seq":1}')
            time.sleep(PACE_S)
            sample = samples.try_recv()
            if sample is not None:
                number, sent_ns, length = struct.unpack_from("<qqB", sample.attachment.to_bytes())
                assert sample.payload.to_bytes() == odometry(1) and len(sample.attachment) == 33 and length == 16
                assert abs(time.time_ns() - sent_ns) < 60 * 10**9
                numbers.append(number)
                gids.add(sample.attachment.to_bytes()[17:])
        with Robot(connect=(endpoint,)) as robot:  # the plain key remains for omnid's clients
            pose = robot.subscribe(Pose).newest()
            assert pose is not None and pose.attachment.seq == 1
    assert len(gids) == 1 and numbers == list(range(numbers[0], numbers[0] + 3))


def test_receives_a_twist_from_ros() -> None:
    endpoint, received = free_endpoint(), []
    key = ros2.data_key(3, "/omnid/cmd/twist", codec.TWIST_SCHEMA)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh", ros2_domain=3))) as bus:
        bus.subscribe_commands(received.append, COMMANDS)
        with session(mode="client", connect__endpoints=[endpoint]) as node:
            message, gid = codec.twist_stamped_cdr(5, "base_link", 0.5, 0.1), bytes(range(16))
            attachment = ros2.attachment(1, 5, gid)
            wait_until(lambda: node.put(key, message, attachment=attachment) is None and bool(received))
    assert received[0][:4] == ("cmd/twist", message, gid.hex(), 5)


@pytest.mark.parametrize("mode", ["client", "peer"])  # a node of ROS 2 is a peer
def test_joins_the_router_of_ros_where_that_holds_the_endpoint(mode: str) -> None:
    endpoint, lines, received, poses = free_endpoint(), list[str](), list[Request](), list[bytes]()
    config = BusConfig(listen=(endpoint,), ros2="rmw_zenoh", ros2_domain=3)
    with (
        script(ROUTER, endpoint),
        contextlib.closing(Bus(config, lines.append)) as bus,
        session(mode=mode, connect__endpoints=[endpoint]) as node,
    ):
        assert lines == [f"the zenoh router at {endpoint} is joined as a client: who may connect is decided there"]
        assert entry(BUS, bus.stats()).values["mode"] == "client" and bus.needs_router
        bus.subscribe_commands(received.append, COMMANDS)
        key, twist = ros2.data_key(3, "/omnid/cmd/twist", "geometry_msgs/msg/Twist"), bytes(52)
        attachment = ros2.attachment(1, 5, bytes(16))
        odom = node.declare_subscriber(
            ros2.data_key(3, "/omnid/odom", codec.ODOMETRY_SCHEMA),
            lambda sample: poses.append(sample.payload.to_bytes()),
        )
        wait_until(
            lambda: (
                node.put(key, twist, attachment=attachment) is None
                and bus.publish("odom", odometry(1)) is None
                and bool(received)
                and bool(poses)
            )
        )
        odom.undeclare()
    assert received[0][:2] == ("cmd/twist", twist) and poses[0] == odometry(1)


SDK = os.environ.get("OMNID_ZENOH_ROS2", "")  # the folder of a virtual environment with zenoh-ros2-sdk
ECHO = """
import sys, time
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession
host, port = sys.argv[1].removeprefix("tcp/").split(":")
known = ZenohSession.get_instance(host, int(port)).store  # definitions that it would download otherwise
known.register({name: kind for name, kind in get_typestore(Stores.ROS2_HUMBLE).fielddefs.items()
                if name not in known.fielddefs and "Odometry" not in name})
def say(message):
    pose = message.pose.pose.position
    print(message.header.stamp.nanosec, message.header.frame_id, message.child_frame_id, pose.x, pose.y, flush=True)
kind = "nav_msgs/msg/Odometry"
definition = open(sys.argv[2]).read()
subscriber = ROS2Subscriber("/omnid/odom", kind, say, definition, router_ip=host, router_port=int(port),
                            type_hash=sys.argv[3])
print("ready", flush=True)
time.sleep(30)
"""


def listed(router: str) -> set[str]:
    """Return the lines of its list; peers discover each other a moment after they have found the router."""
    result = subprocess.run(
        [
            f"{SDK}/bin/zenoh-ros2",
            "--no-daemon",
            "--router",
            router.removeprefix("tcp/"),
            "--timeout",
            "3",
            "topic",
            "list",
            "-t",
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    return set(result.stdout.splitlines())


@pytest.mark.skipif(
    not SDK or shutil.which(f"{SDK}/bin/zenoh-ros2") is None,
    reason="needs zenoh-ros2-sdk in a virtual environment that OMNID_ZENOH_ROS2 names",
)
def test_a_separate_program_lists_and_reads_the_topics(tmp_path: Path) -> None:
    """zenoh-ros2-sdk 0.1.8: `topic list -t` and a subscriber."""
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        stack.enter_context(script(ROUTER, endpoint))
        config = BusConfig(listen=(free_endpoint(),), connect=(endpoint,), ros2="rmw_zenoh")
        bus = stack.enter_context(contextlib.closing(Bus(config)))
        bus.subscribe_commands(lambda *_: None, COMMANDS)
        topics = {name: topic.schema for name, topic in PUBLISHED.items() if name != "/clock"} | COMMANDS
        wait_until(lambda: listed(endpoint) >= {f"{ros_name('omnid', name)} [{topics[name]}]" for name in topics})
        (tmp_path / "Odometry.msg").write_text(
            "std_msgs/Header header\nstring child_frame_id\n"
            "geometry_msgs/PoseWithCovariance pose\n"
            "geometry_msgs/TwistWithCovariance twist\n"
        )
        echo = subprocess.Popen(
            [
                f"{SDK}/bin/python",
                "-c",
                ECHO,
                endpoint,
                str(tmp_path / "Odometry.msg"),
                ros2.type_hash(codec.ODOMETRY_SCHEMA),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(echo.wait)
        stack.callback(echo.kill)
        assert echo.stdout is not None
        while "ready" not in echo.stdout.readline():
            assert echo.poll() is None
        os.set_blocking(echo.stdout.fileno(), False)
        lines: list[str] = []
        wait_until(lambda: bus.publish("odom", odometry(4)) is None and bool(lines.extend(echo.stdout) or lines))
    assert lines[0].split() == ["4", "odom", "base_link", "1.0", "-1.0"]
