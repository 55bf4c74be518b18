"""The bus against a subscriber in a process of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from omnid.client import Pose, Robot, Unreachable
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import OK, WARN
from tests.omnid.transport.bus_fixtures import DEADLINE_S, ROUTER, free_endpoint, numbers, odometry, script
from tests.omnid.transport.bus_fixtures import SUBSCRIBER as STAMP_SUBSCRIBER
from tests.waiting import wait_until

SUBSCRIBER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    samples = session.declare_subscriber(sys.argv[2], zenoh.handlers.FifoChannel(1000))
    print("ready", flush=True)
    for _ in range(int(sys.argv[3])):
        s = samples.recv()
        print(s.key_expr, s.encoding, s.priority, s.congestion_control, s.express, flush=True)
        print(bytes(s.payload).hex(), flush=True)
"""


@contextlib.contextmanager
def subscriber(endpoint: str, key: str, count: int) -> Iterator[subprocess.Popen[str]]:
    arguments = [sys.executable, "-c", SUBSCRIBER, endpoint, key, str(count)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def publish_until_done(bus: Bus, key: str, process: subprocess.Popen[str]) -> list[str]:
    """Publish until the subscriber, whose subscription takes a moment to arrive, has all messages; return its lines."""
    deadline = time.monotonic() + DEADLINE_S
    for i in range(10_000):
        bus.publish(key, odometry(i))
        time.sleep(0.005)
        if process.poll() is not None or time.monotonic() > deadline:
            break
    process.kill()
    assert process.stdout is not None
    return process.stdout.read().splitlines()


def test_another_process_reads_the_same_odometry() -> None:
    endpoint = free_endpoint()
    bus = Bus(BusConfig(robot="site/robot-1", listen=(endpoint,)))
    with contextlib.closing(bus), subscriber(endpoint, "site/robot-1/**", 5) as process:
        lines = publish_until_done(bus, "odom", process)
    assert lines[0::2] == ["site/robot-1/odom application/cdr Priority.REAL_TIME CongestionControl.DROP False"] * 5
    records = [codec.odometry_from_cdr(bytes.fromhex(line)) for line in lines[1::2]]
    for record in records:
        expected = codec.odometry_from_cdr(odometry(record.stamp_ns - 10**9))
        np.testing.assert_array_equal(record.T_odom_base, expected.T_odom_base)
        np.testing.assert_array_equal(record.covariance, expected.covariance)


def listening() -> set[str]:
    """Return the sockets that this process listens on or has bound, as `address:port` in the kernel's hex."""
    inodes = {os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    rows = [line.split() for table in ("tcp", "tcp6", "udp", "udp6") for line in _table(table)]
    return {row[1] for row in rows if f"socket:[{row[9]}]" in inodes and row[3] in ("0A", "07")}


def _table(name: str) -> list[str]:
    path = Path("/proc/self/net") / name
    return path.read_text().splitlines()[1:] if path.exists() else []


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs Linux's /proc")
def test_opens_the_given_endpoint_only() -> None:
    before, endpoint = listening(), free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))):
        assert listening() - before == {f"0100007F:{int(endpoint.rsplit(':')[-1]):04X}"}
    with contextlib.closing(Bus(BusConfig(listen=()))):
        assert listening() - before == set()


def test_default_is_this_machine_only() -> None:
    assert (BusConfig().listen, BusConfig().connect) == (("tcp/127.0.0.1:7447",), ())


def test_a_peer_publishes_without_its_router() -> None:
    with contextlib.closing(Bus(BusConfig(listen=(free_endpoint(),), connect=(free_endpoint(),)))) as bus:
        bus.publish("odom", odometry(1))


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


@pytest.mark.slow
def test_closes_although_a_subscriber_is_stopped() -> None:
    """The subscriber's process is stopped in the middle of a run: zenoh waits 10 s for it at the end, then gives up."""
    endpoint = free_endpoint()
    with subprocess.Popen([sys.executable, "-c", PEER, endpoint], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            bus = Bus(BusConfig(listen=(), connect=(endpoint,)))
            time.sleep(0.5)
            process.send_signal(signal.SIGSTOP)
            for i in range(70):
                bus.publish("odom", odometry(i))
                bus.publish("pose", bytes(120))
                time.sleep(0.1)
            bus.publish("cloud", bytes(300_000))
            bus.close()
            bus.close()
        finally:
            process.kill()


def test_direct_subscribers_lose_nothing_when_a_router_is_killed(tmp_path: Path) -> None:
    """Subscribers behind the router receive again once another has taken its place."""
    here, there = free_endpoint(), free_endpoint()
    direct, behind = tmp_path / "direct", tmp_path / "behind"
    sequence = count()
    with contextlib.ExitStack() as stack:
        router = stack.enter_context(script(ROUTER, there))
        bus = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(here,), connect=(there,), retry_s=0.5))))
        stack.enter_context(script(STAMP_SUBSCRIBER, here, "omnid/odom", str(direct)))
        stack.enter_context(script(STAMP_SUBSCRIBER, there, "omnid/odom", str(behind)))

        def publish() -> int:
            number = next(sequence)
            bus.publish("odom", odometry(number))
            return number

        wait_until(lambda: publish() >= 0 and bool(numbers(direct) and numbers(behind)))
        router.kill()
        router.wait()
        last = [publish() for _ in range(100) if time.sleep(0.005) is None][-1]
        stack.enter_context(script(ROUTER, there))
        wait_until(lambda: publish() >= 0 and numbers(behind)[-1] > last)
        wait_until(lambda: numbers(direct)[-1] >= last)
        received = numbers(direct)
    assert received == list(range(received[0], received[0] + len(received)))
    assert max(np.diff(numbers(behind))) > 50, "the router was away"


def appears(endpoint: str) -> bool:
    """True if a robot can be reached by the router."""
    try:
        Robot(connect=(endpoint,)).close()
    except Unreachable:
        return False
    return True


def test_a_client_waits_for_its_router() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(mode="client", listen=(), connect=(endpoint,)))) as bus:
        received: list[str] = []
        bus.subscribe_commands(lambda request: received.append(request.topic), {})
        bus.serve("config", "robot = 1")
        bus.connect()
        bus.publish("odom", odometry(1))
        assert bus.status().level == WARN and bus.status().values["lost"] == "1"
        assert bus.status().message == f"no router yet at {endpoint}"
        with script(ROUTER, endpoint):
            wait_until(lambda: bus.connect() is None and bus.status().level == OK)
            bus.publish("odom", odometry(2))
            assert bus.status().values["lost"] == "1"
            wait_until(lambda: appears(endpoint))
            with Robot(connect=(endpoint,)) as robot:
                wait_until(lambda: robot.query("config") == "robot = 1")  # the router hears of it a moment later
                driver = robot.driver()
                wait_until(lambda: driver.stop() is None and "cmd/stop" in received)
                pose = robot.subscribe(Pose).newest()
                assert pose is not None and pose.stamp_ns == 10**9 + 2
            assert (bus.status().level, bus.status().message) == (OK, "open")


def test_a_second_instance_is_refused_with_the_knob_to_change() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))), pytest.raises(OmnidError) as caught:
        Bus(BusConfig(listen=(endpoint,)))
    text = str(caught.value)
    assert endpoint in text and "bus.listen" in text and "in use" in text
    assert "\n" not in text and ".rs:" not in text


def test_a_port_that_is_taken_or_silent_is_refused_in_two_words() -> None:
    endpoint = free_endpoint()
    taken = pytest.raises(OmnidError, match=r"\(Address already in use\)$")
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))), taken:
        Bus(BusConfig(robot="other", listen=(endpoint,)))
    with pytest.raises(Unreachable, match=r"change bus.connect \((no answer|Connection refused)\)$"):
        Robot(connect=(endpoint,))


@pytest.mark.parametrize("robot", ["", "/omnid", "omnid/", "a//b", "*", "a/**", "a$b", "a#b", "a?b", "@a", "a b"])
def test_robot_name_must_be_plain(robot: str) -> None:
    with pytest.raises(OmnidError, match=r"bus\.robot"):
        Bus(BusConfig(robot=robot, listen=()))


@pytest.mark.parametrize("endpoint", ["", "nonsense", "127.0.0.1:7447", "tcp/127.0.0.1", "foo/127.0.0.1:1"])
def test_endpoints_must_have_protocol_and_port(endpoint: str) -> None:
    with pytest.raises(OmnidError, match=r"bus\.listen"):
        Bus(BusConfig(listen=(endpoint,)))
    with pytest.raises(OmnidError, match=r"bus\.connect"):
        Bus(BusConfig(listen=(), connect=(endpoint,)))
