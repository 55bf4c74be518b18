"""The bus against other sessions and processes: settings, publishing, routers, late subscribers, namesakes, crowds."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import sys
import threading
import time
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import ext

from omnid.client import Pose, Robot, Unreachable, subscribe
from omnid.errors import OmnidError
from omnid.transport import codec, ros2
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import ERROR, OK, WARN, PoseAttachment
from omnid.transport.session import open_client, open_session, zenoh_config
from omnid.transport.status_names import BUS, entry
from omnid.transport.topics import COMMANDS, PUBLISHED, command_topics, request_key
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, odometry, script, session
from tests.waiting import wait_until

PEER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    received = session.declare_subscriber("omnid/**", lambda sample: None)
    print("ready", flush=True)
    time.sleep(100)
"""


# Settings.


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        *(
            ({"robot": name}, r"bus\.robot")
            for name in ("", "/a", "a/", "a//b", "*", "a/**", "a$b", "a?b", "@a", "a b")
        ),
        ({"robot": "robot-1", "ros2": "rmw_zenoh"}, "ROS 2 takes"),
        *(
            ({name: (endpoint,)}, rf"bus\.{name}.*write protocol/host:port")
            for endpoint in ("", "nonsense", "127.0.0.1:7447", "tcp/127.0.0.1", "foo/127.0.0.1:1")
            for name in ("listen", "connect")
        ),
        ({"config": "/nowhere.json5"}, r"bus\.config.*nowhere.*No such file"),
        ({"config": sys.executable}, r"bus\.config.*not text"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(OmnidError, match=words) as caught:
        Bus(BusConfig(**({"listen": ()} | settings)))
    assert "\n" not in str(caught.value)


def setting(config: BusConfig, key: str) -> Any:
    return json.loads(zenoh_config(config).get_json(key))


def test_the_default_is_this_machine_only() -> None:
    config, protocols = BusConfig(), "transport/link/protocols"
    assert (config.listen, config.connect, config.is_client) == (("tcp/127.0.0.1:7447",), (), False)
    assert setting(config, "listen/endpoints") == ["tcp/127.0.0.1:7447"] and setting(config, protocols) == ["tcp"]
    assert not setting(config, "scouting/multicast/enabled") and not setting(config, "scouting/gossip/enabled")
    assert setting(config, "access_control")["default_permission"] == "deny"
    limited = setting(BusConfig(robot="rover", ros2_domain=3), "low_pass_filter")[0]["key_exprs"]
    topics = command_topics(("planner",)).keys() - {"cmd/path"}
    keys = [f"rover/{topic}" for topic in topics] + [f"3/rover/{topic}/type/hash" for topic in topics]
    keys += [f"rover/{request_key(topic)}" for topic in COMMANDS if COMMANDS[topic].is_request and topic != "cmd/path"]
    assert all(any(zenoh.KeyExpr(bound).includes(zenoh.KeyExpr(key)) for bound in limited) for key in keys)
    both = BusConfig(listen=("tls/[::]:7447",), connect=("quic/site:1", "tls/site:1"))
    assert setting(both, protocols) == ["quic", "tls"] and setting(both, "mode") == "peer"
    limit = "transport/link/rx/max_message_size"
    router = zenoh_config(BusConfig(listen=(), connect=("tcp/127.0.0.1:1",)), guarded=False)
    assert setting(config, limit) == 1 << 20 and json.loads(router.get_json("mode")) == "client"
    assert json.loads(router.get_json(limit)) > 1 << 28, "a cloud of ten million points is sent as one message"


def test_zenohs_own_file_says_all_but_the_endpoints(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("""{ // as zenohd reads it
        mode: "router", listen: {endpoints: ["tcp/127.0.0.1:1"]},
        access_control: {enabled: true, default_permission: "allow"},
        transport: {link: {protocols: ["udp"], tx: {lease: 1234}}} }""")
    config = BusConfig(config=str(path), connect=("tcp/127.0.0.1:3",))
    assert setting(config, "mode") == "peer" and setting(config, "listen/endpoints") == ["tcp/127.0.0.1:7447"]
    assert setting(config, "connect/endpoints") == ["tcp/127.0.0.1:3"]
    assert setting(config, "transport/link/tx/lease") == 1234
    assert setting(config, "access_control")["default_permission"] == "allow"
    assert setting(config, "transport/link/protocols") == ["udp"]
    assert setting(config, "scouting/multicast/enabled") is False
    path.write_text("{ mode: 'emperor' }")
    with pytest.raises(OmnidError, match=r"bus\.config") as caught:
        open_session(config)
    assert "\n" not in str(caught.value) and ".rs:" not in str(caught.value)


# Publishing.


def test_a_program_reads_the_same_odometry() -> None:
    endpoint, came = free_endpoint(), list[zenoh.Sample]()
    with (
        contextlib.closing(Bus(BusConfig(robot="site/robot-1", listen=(endpoint,)))) as bus,
        session(mode="client", connect__endpoints=[endpoint]) as program,
    ):
        subscriber = program.declare_subscriber("site/robot-1/**", came.append)
        numbers = count()
        wait_until(lambda: bus.publish("odom", odometry(next(numbers))) is None and len(came) >= 5)
        subscriber.undeclare()
    assert (came[0].express, came[0].congestion_control) == (False, zenoh.CongestionControl.DROP)
    for sample in came:
        assert (str(sample.key_expr), str(sample.encoding)) == ("site/robot-1/odom", "application/cdr")
        assert sample.priority == zenoh.Priority.REAL_TIME
        record = codec.decode_pose(sample.payload.to_bytes())
        assert sample.payload.to_bytes() == odometry(record.stamp_ns - 10**9)


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
            assert [robot.query("rig") for _ in range(50)] == ["name = 'rig'"] * 50
            assert robot.query("nothing") == "" and robot.alive
    with pytest.raises(Unreachable):
        Robot(connect=(endpoint,))


def test_late_subscribers_of_ros_receive_the_static_frames() -> None:
    """A subscriber that is transient local in ROS 2 is an AdvancedSubscriber with history of zenoh."""
    endpoint, key = free_endpoint(), ros2.data_key(0, "/tf_static", codec.TRANSFORM_SCHEMA)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh"))) as bus:
        for payload in (b"before a refinement", b"frames"):
            bus.publish("/tf_static", payload)
        with session(mode="client", connect__endpoints=[endpoint]) as late:
            history, came = ext.HistoryConfig(detect_late_publishers=True, max_samples=1), list[bytes]()
            subscriber = ext.declare_advanced_subscriber(
                late, key, lambda sample: came.append(sample.payload.to_bytes()), history=history
            )
            wait_until(lambda: bool(came))
            bus.publish("/tf_static", b"refined")
            wait_until(lambda: len(came) == 2)
            subscriber.undeclare()
            found: set[str] = set()

            def have_come() -> bool:
                replies = late.liveliness().get("@ros2_lv/**")
                found.update(str(reply.ok.key_expr) for reply in replies if reply.ok)
                return len(found) >= len(PUBLISHED) - 1  # /clock is that of a simulation

            wait_until(have_come)
    kept = {
        topic
        for topic in ("tf_static", "map", "tf", "map_pose")
        for token in found
        if re.search(f"[%/]{topic}/", token) and token.endswith("/" + ros2.TRANSIENT_LOCAL)
    }
    assert not any("clock" in token for token in found)
    assert came == [b"frames", b"refined"] and kept == {"tf_static", "map"}


# Endpoints and routers.


def listening() -> set[str]:
    """Return the sockets that this process listens on or has bound, as `address:port` in the kernel's hex."""
    inodes = {os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    tables = (Path("/proc/self/net") / name for name in ("tcp", "tcp6", "udp", "udp6"))
    rows = [line.split() for table in tables if table.exists() for line in table.read_text().splitlines()[1:]]
    return {row[1] for row in rows if f"socket:[{row[9]}]" in inodes and row[3] in ("0A", "07")}


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs Linux's /proc")
def test_opens_the_given_endpoint_only() -> None:
    before, endpoint = listening(), free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))):
        assert listening() - before == {f"0100007F:{int(endpoint.rsplit(':')[-1]):04X}"}
    with contextlib.closing(Bus(BusConfig(listen=()))):
        assert listening() - before == set()


def test_a_taken_or_silent_endpoint_is_refused_with_the_setting_to_change() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))), pytest.raises(OmnidError) as caught:
        Bus(BusConfig(robot="other", listen=(endpoint,)))
    text = str(caught.value)
    assert endpoint in text and "bus.listen" in text and text.endswith("(Address already in use)") and "\n" not in text
    with pytest.raises(Unreachable, match=r"change bus.connect \((no answer|Connection refused)\)$"):
        Robot(connect=(endpoint,))
    with pytest.raises(OmnidError, match="write protocol/host:port") as wrong:
        open_client(BusConfig(connect=("nowhere",)), timeout_s=60.0)
    assert not isinstance(wrong.value, Unreachable)


@pytest.mark.slow
def test_closes_although_a_subscriber_is_stopped() -> None:
    """The subscriber's process is stopped in the middle of a run: zenoh waits 10 s for it at the end, then gives up."""
    endpoint = free_endpoint()
    with script(PEER, endpoint) as process:
        bus = Bus(BusConfig(listen=(free_endpoint(),), connect=(endpoint,)))
        time.sleep(0.5)
        process.send_signal(signal.SIGSTOP)
        for i in range(70):
            bus.publish("odom", odometry(i))
            bus.publish("pose", bytes(120))
            time.sleep(0.1)
        bus.publish("cloud", bytes(300_000))
        bus.close()
        bus.close()


def appears(endpoint: str) -> bool:
    """True if a robot can be reached by the router."""
    try:
        Robot(connect=(endpoint,)).close()
    except Unreachable:
        return False
    return True


def test_a_client_waits_for_its_router() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(), connect=(endpoint,)))) as bus:
        received: list[str] = []
        bus.subscribe_commands(lambda request: received.append(request.topic), {})
        bus.serve("config", "robot = 1")
        bus.connect()
        bus.publish("odom", odometry(1))
        assert entry(BUS, bus.stats()).level == WARN and entry(BUS, bus.stats()).values["lost"] == "1"
        assert entry(BUS, bus.stats()).message == f"no router yet at {endpoint}"
        with script(ROUTER, endpoint):
            wait_until(lambda: bus.connect() is None and entry(BUS, bus.stats()).level == OK)
            bus.publish("odom", odometry(2))
            assert entry(BUS, bus.stats()).values["lost"] == "1"
            wait_until(lambda: appears(endpoint))
            with Robot(connect=(endpoint,)) as robot:
                wait_until(lambda: robot.query("config") == "robot = 1")  # the router hears of it a moment later
                driver = robot.driver()
                wait_until(lambda: driver.stop() is None and "cmd/stop" in received)
                pose = robot.subscribe(Pose).newest()
                assert pose is not None and pose.stamp_ns == 10**9 + 2
            assert (entry(BUS, bus.stats()).level, entry(BUS, bus.stats()).message) == (OK, "open")


# Robots of one name.


@pytest.mark.hazard("H48")
def test_starts_disarmed_beside_a_robot_of_the_same_name() -> None:
    router = free_endpoint()
    with script(ROUTER, router), contextlib.ExitStack() as stack:

        def started(robot: str = "omnid") -> Bus:
            bus = stack.enter_context(contextlib.closing(Bus(BusConfig(robot, (), (router,)), warnings.append)))
            wait_until(lambda: bus.connect() is None and not entry(BUS, bus.stats()).message.startswith("no router"))
            return bus

        warnings, commands = list[str](), list[str]()
        first = started()
        second = started()
        wait_until(lambda: len(warnings) == 2)
        assert "change bus.robot" in warnings[0] and "\n" not in warnings[0]
        second.subscribe_commands(lambda request: commands.append(request.topic), {})
        assert entry(BUS, second.stats()).level == ERROR and not second.is_unique and commands == ["cmd/stop"]
        assert (
            entry(BUS, second.stats()).values["same_name"] == "1" and entry(BUS, started("other").stats()).level == OK
        )
        first.close()
        wait_until(lambda: entry(BUS, second.stats()).level == OK and second.is_unique)
        assert len(warnings) == 2, "each warns once"


@pytest.mark.hazard("H48")
def test_warns_once_of_a_robot_of_the_same_name_that_appears_later() -> None:
    """Two robots start as clients without a router, which connects them later."""
    router, warnings, commands = free_endpoint(), list[str](), list[str]()
    with contextlib.ExitStack() as stack:
        first, second = (
            stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(), connect=(router,)), warnings.append)))
            for _ in range(2)
        )
        first.subscribe_commands(lambda request: commands.append(request.topic), {})
        connection = stack.enter_context(script(ROUTER, router))
        wait_until(
            lambda: (
                bool([bus.connect() for bus in (first, second)])
                and entry(BUS, first.stats()).level == entry(BUS, second.stats()).level == ERROR
            )
        )
        assert "bus.robot" in entry(BUS, first.stats()).message and len(warnings) == 2 and commands == ["cmd/stop"]
        connection.kill()
        wait_until(lambda: entry(BUS, first.stats()).level == entry(BUS, second.stats()).level == OK)
        assert len(warnings) == 2, "each warns once"


# Crowds and floods.


def test_does_not_connect_to_a_peer_that_another_one_introduces() -> None:
    """A viewer that is connected to the robot and to an intruder does not bring the two together.

    The intruder waits for connections: that of a robot would need no credentials.
    """
    here, there, control = free_endpoint(), free_endpoint(), free_endpoint()
    with contextlib.ExitStack() as stack:
        intruder = stack.enter_context(session(listen__endpoints=[there], scouting__gossip__autoconnect=[]))
        received = threading.Event()
        intruder.declare_subscriber("omnid/odom", lambda _: received.set())
        bus = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(here,)))))
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        # A third peer that keeps zenoh's defaults shows that the introduction has taken place.
        other = stack.enter_context(session(listen__endpoints=[control]))
        viewer = stack.enter_context(session(listen__endpoints=[], connect__endpoints=[here, there, control]))
        wait_until(lambda: intruder.zid() in other.info.peers_zid() and len(viewer.info.peers_zid()) == 3)
        for i in range(20):
            bus.publish("odom", odometry(i))
            intruder.put("omnid/cmd/stop", b"")
        viewer.put("omnid/cmd/stop", b"")
        wait_until(lambda: bool(commands))
        assert bus._session is not None
        assert intruder.zid() not in bus._session.info.peers_zid() and not received.is_set()
