"""The bus against other sessions and processes: settings, publishing, ROS 2, routers, namesakes, intake, datagrams."""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import struct
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import ext

from omnid.client import Answer, Pose, Robot, Unreachable
from omnid.errors import OmnidError
from omnid.transport import codec, ros2
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import ERROR, OK, PoseAttachment
from omnid.transport.session import open_client, open_session, zenoh_config
from omnid.transport.status_names import BUS, entry
from omnid.transport.stop_datagram import ASKED, STOPPED, StopListener, StopSender, addresses
from omnid.transport.topics import COMMANDS, PUBLISHED, Request, request_key
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, odometry, robot, script, session
from tests.waiting import wait_until

# Settings.


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        *(({"robot": name}, r"bus\.robot") for name in ("", "/a", "a//b", "a/**", "a b")),
        ({"robot": "robot-1", "ros2": "rmw_zenoh"}, r"bus\.robot.*with ROS 2"),
        *(({name: ("127.0.0.1:7447",)}, rf"bus\.{name}.*an example is tcp/") for name in ("listen", "connect")),
        ({"listen": ("foo/127.0.0.1:1",)}, r"bus\.listen.*foo"),
        ({"config": "/nowhere.json5"}, r"bus\.config.*nowhere.*No such file"),
        ({"config": sys.executable}, r"bus\.config"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(OmnidError, match=words) as caught:
        Bus(BusConfig(**({"listen": ()} | settings)))
    assert "\n" not in str(caught.value) and ".rs:" not in str(caught.value)


def setting(config: BusConfig, key: str) -> Any:
    return json.loads(zenoh_config(config).get_json(key))


def test_the_default_is_this_machine_only() -> None:
    config, protocols = BusConfig(), "transport/link/protocols"
    assert (config.listen, config.connect, config.is_client) == (("tcp/127.0.0.1:7447",), (), False)
    assert setting(config, "listen/endpoints") == ["tcp/127.0.0.1:7447"] and setting(config, protocols) == ["tcp"]
    assert not setting(config, "scouting/multicast/enabled") and not setting(config, "scouting/gossip/enabled")
    assert setting(config, "access_control")["default_permission"] == "deny"
    limited = setting(BusConfig(robot="rover", ros2_domain=3), "low_pass_filter")[0]["key_exprs"]
    topics = COMMANDS.keys() - {"cmd/path"}
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


def test_late_subscribers_receive_the_newest_message_at_once() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        for i in range(3):
            bus.publish("odom", odometry(i), PoseAttachment(i, "degraded", 4).to_bytes())
        bus.serve("rig", "name = 'rig'")
        with Robot(connect=(endpoint,)) as robot:
            pose = robot.subscribe(Pose).newest()
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
def test_the_bus_opens_the_given_endpoint_only() -> None:
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
    assert endpoint in text and "bus.listen" in text and "Address already in use" in text and "\n" not in text
    with pytest.raises(Unreachable, match=r"by --connect or bus\.connect"):
        Robot(connect=(endpoint,))
    with pytest.raises(OmnidError, match="an example is") as wrong:
        open_client(BusConfig(connect=("nowhere",)))
    assert not isinstance(wrong.value, Unreachable)


# Robots of one name.


@pytest.mark.hazard("H48")
def test_a_robot_starts_disarmed_beside_one_of_the_same_name() -> None:
    router = free_endpoint()
    with script(ROUTER, router), contextlib.ExitStack() as stack:

        def started(robot: str = "omnid") -> Bus:
            return stack.enter_context(contextlib.closing(Bus(BusConfig(robot, (), (router,)), warnings.append)))

        warnings, commands = list[str](), list[str]()
        first = started()
        second = started()
        wait_until(lambda: len(warnings) == 2)
        assert "change bus.robot" in warnings[0] and "\n" not in warnings[0]
        second.subscribe_commands(lambda request: commands.append(request.topic))
        assert entry(BUS, second.stats()).level == ERROR and not second.is_unique and commands == ["cmd/stop"]
        assert (
            entry(BUS, second.stats()).values["same_name"] == "1" and entry(BUS, started("other").stats()).level == OK
        )
        first.close()
        wait_until(lambda: entry(BUS, second.stats()).level == OK and second.is_unique)
        assert len(warnings) == 2, "each warns once"


# Crowds and floods.


ODOMETRY_KEY = (
    "0/omnid/odom/nav_msgs::msg::dds_::Odometry_/"
    "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
)
# As published by ROS 2's own type description service, first digits; Odometry's is in ODOMETRY_KEY.
HASHES = {"std_msgs/msg/String": "df668c74", "tf2_msgs/msg/TFMessage": "e369d0f0"}
PACE_S = 0.01  # between messages, so that a reader which is slow for a moment has them all


@pytest.mark.parametrize("schema", HASHES)
def test_type_hashes_are_those_of_ros(schema: str) -> None:
    assert ros2.type_hash(schema).startswith(f"RIHS01_{HASHES[schema]}") and len(ros2.type_hash(schema)) == 71


def test_the_attachment_equals_that_of_zenohs_serializer() -> None:
    gid = bytes(range(16))
    made = ros2.attachment(7, 1_700_000_000_123_456_789, gid)
    assert len(made) == 33
    assert made == bytes(ext.z_serialize((ext.Int64(7), ext.Int64(1_700_000_000_123_456_789), gid)))


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


def test_the_bus_receives_a_twist_from_ros() -> None:
    endpoint, received = free_endpoint(), []
    key = ros2.data_key(3, "/omnid/cmd/twist", codec.TWIST_SCHEMA)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), ros2="rmw_zenoh", ros2_domain=3))) as bus:
        bus.subscribe_commands(received.append)
        with session(mode="client", connect__endpoints=[endpoint]) as node:
            message, gid = codec.twist_stamped_cdr(5, "base_link", 0.5, 0.1), bytes(range(16))
            attachment = ros2.attachment(1, 5, gid)
            wait_until(lambda: node.put(key, message, attachment=attachment) is None and bool(received))
    assert received[0][:4] == ("cmd/twist", message, gid.hex(), 5)


REQUEST_TOPICS = {topic for topic, command in COMMANDS.items() if command.is_request}


@pytest.mark.hazard("H49")
def test_a_query_for_several_keys_is_no_request() -> None:
    """Else one query would arm the robots of a whole site, and give each topic a payload of another."""
    with robot() as (_, program, received):
        for key in ("**", "omnid/**", "*/@request/arm", "omnid/@request/*", "**/@request/**", "omnid/*/arm"):
            assert list(program._session.get(key, payload=codec.header_cdr(time.time_ns()), timeout=1.0)) == [], key
        assert received == []


def test_of_a_stop_and_a_request_to_arm_in_one_pass_the_stop_wins() -> None:
    with robot() as (bus, program, received):
        driver = program.driver()
        driver.require_connected()
        bus._pollers[-2].close()  # the passes are made here
        stop, ask = program._session.put, program._session.get
        stop("omnid/cmd/stop", b"")
        reply = ask("omnid/@request/arm", payload=codec.header_cdr(time.time_ns()), timeout=5.0)
        time.sleep(0.5)
        bus._take_commands()
        assert [request.topic for request in received] == ["cmd/stop", "cmd/arm", "cmd/stop"]
        del reply


def test_large_requests_are_dropped_before_they_wait() -> None:
    with robot() as (_, program, received):
        for topic in sorted(REQUEST_TOPICS - {"cmd/path"}):
            with pytest.raises(OmnidError, match="has not answered"):
                program.driver().ask(topic, lambda _: bytes(20_000), timeout_s=0.2)
        assert received == []
        with pytest.raises(OmnidError, match="has not answered"):
            program.driver().ask("cmd/path", lambda _: bytes(20_000), timeout_s=0.2)
        assert [request.topic for request in received] == ["cmd/path"]


FLOOD = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    key, block = sys.argv[2], zenoh.CongestionControl.BLOCK
    publisher = session.declare_publisher(key, congestion_control=block)
    print("ready", flush=True)
    while "@" not in key:
        publisher.put(b"")
    while True:
        session.get(key, lambda reply: None, payload=b"", congestion_control=block, timeout=1.0)
"""


@pytest.mark.hazard("H52")
@pytest.mark.parametrize("key", ["cmd/imu", "cmd/arm", "@request/path"])
def test_a_flood_on_one_key_is_bounded_and_keeps_no_other_key_out(key: str) -> None:
    """Of the flood no more than the budget is passed on; a stop and a command on another key get through."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: Counter[str] = Counter()

        def count(request: Request) -> None:
            commands[request.topic] += 1

        bus.subscribe_commands(count)
        with script(FLOOD, endpoint, f"omnid/{key}"), Robot(connect=(endpoint,)) as operator:
            driver = operator.driver()
            wait_until(lambda: bus.stats()["floods"] != 0)
            topic = key.replace("@request", "cmd")
            begin_s, before = time.monotonic(), commands[topic]
            wait_until(lambda: driver.stop() is None and commands["cmd/stop"] > 0)
            wait_until(lambda: driver.twist(0.1, 0.0) is None and commands["cmd/twist"] > 0)
            time.sleep(1.0)
            rate_hz = COMMANDS[topic].rate_hz
            assert commands[topic] - before <= 2 * max(4, rate_hz / 4) + rate_hz * (time.monotonic() - begin_s)


def test_a_request_gets_the_answer_that_is_given_later() -> None:
    answer = Answer(False, "not armed: d\u00e9sarm\u00e9\n" * 50)
    with robot() as (bus, program, received), ThreadPoolExecutor(1) as thread:
        asked = thread.submit(program.driver().route, "repeat hall")
        wait_until(lambda: bool(received))
        assert received[0].topic == "cmd/route" and received[0].sender and received[0].id > 0
        assert abs(received[0].sent_ns - time.time_ns()) < 60 * 10**9 and not asked.done()
        bus.answer({received[0].id: answer})
        bus.answer({received[0].id: Answer(False, "a second one")})
        assert asked.result() == answer


def test_a_stop_is_confirmed_only_where_the_robot_says_so() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic))
        with contextlib.closing(StopSender("rover", (endpoint,))) as sender:
            wait_until(lambda: sender.ask(0.1) == ASKED)
        assert commands
        commands.clear()
        with contextlib.closing(StopSender("other", (endpoint,))) as sender:
            assert sender.ask(0.3) == "" and not commands, "it is for another robot"


def test_a_confirmed_stop_stays_confirmed_when_an_older_answer_comes_by_another_way() -> None:
    endpoints = (free_endpoint(), free_endpoint())
    with contextlib.ExitStack() as closing, ThreadPoolExecutor(1) as thread:
        sender = closing.enter_context(contextlib.closing(StopSender("rover", endpoints)))
        listeners = []
        for endpoint, is_stopped in zip(endpoints, (True, False), strict=True):
            config = BusConfig(robot="rover", listen=(endpoint,))
            listener = StopListener(config, lambda: None, lambda is_stopped=is_stopped: is_stopped)  # type: ignore[misc]
            listeners.append(closing.enter_context(contextlib.closing(listener)))
        answer = thread.submit(sender.ask, 1.0)
        while not answer.done():
            for listener in listeners:
                listener.process()
        assert answer.result() == STOPPED


def test_other_datagrams_do_not_stop_and_answers_are_no_longer_than_requests() -> None:
    endpoint = free_endpoint()
    host, port = next(iter(addresses((endpoint,))))
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), lambda: True)
        good = b"omnid stop 1 0123456789abcdef omnid" + b" " * 8
        for data in (b"", b"\xff" * 2000, good[:-12], good.upper(), good + b"\n", good.replace(b"omnid ", b"omni ")):
            stranger.sendto(data, (host, port))
        stranger.sendto(good, (host, port))
        stranger.settimeout(30.0)
        answer = stranger.recv(4096)
        assert answer.endswith(STOPPED.encode()) and len(answer) <= len(good) and commands == ["cmd/stop"]


@pytest.mark.parametrize(
    ("asked", "proof"),
    [("", False), ("auth: {usrpwd: {dictionary_file: 'users'}}", True), ("link: {tls: {enable_mtls: true}}", True)],
)
def test_beyond_this_machine_only_without_users_and_certificates(tmp_path: Path, asked: str, proof: bool) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    (tmp_path / "zenoh.json5").write_text(f"{{transport: {{{asked}}}}}")
    config = BusConfig(listen=(f"tcp/0.0.0.0:{port}",), config=str(tmp_path / "zenoh.json5"))
    listener = StopListener(config, lambda: None, lambda: False)
    with contextlib.closing(listener):
        assert [found.getsockname()[0] for found in listener._sockets] == ["127.0.0.1" if proof else "0.0.0.0"]
