"""Attacks on the bus by programs that may connect and may not command: real sessions on this machine."""

from __future__ import annotations

import contextlib
import socket
import threading
from pathlib import Path

import pytest
import zenoh

from omnid.client import Robot
from omnid.transport import session as transport_session
from omnid.transport.bus import Bus, BusConfig
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry, script, session
from tests.waiting import wait_until


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
        wait_until(lambda: str(intruder.zid()) in peers(other))
        wait_until(lambda: len(peers(viewer)) == 3)
        for i in range(20):
            bus.publish("odom", odometry(i))
            intruder.put("omnid/cmd/stop", b"")
        viewer.put("omnid/cmd/stop", b"")
        wait_until(lambda: bool(commands))
        assert str(intruder.zid()) not in peers_of(bus) and not received.is_set()


def peers(opened: zenoh.Session) -> set[str]:
    return {str(zid) for zid in opened.info.peers_zid()}


def peers_of(bus: Bus) -> set[str]:
    assert bus._session is not None
    return peers(bus._session)


def resident_mb() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) // 1024


FLOODER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("transport/shared_memory/enabled", "false")
session = zenoh.open(config)
session.put("anything/else", bytes(300_000_000), congestion_control=zenoh.CongestionControl.BLOCK)
print("ready", flush=True)
import time
time.sleep(1000)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_does_not_collect_large_messages() -> None:
    """The sender may not write anything; 300 MB of one message would be kept until its last byte otherwise."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        before_mb, halt, most_mb = resident_mb(), threading.Event(), [0]

        def watch() -> None:
            while not halt.wait(0.01):
                most_mb[0] = max(most_mb[0], resident_mb())

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            with script(FLOODER, endpoint), Robot(connect=(endpoint,)) as operator:
                driver = operator.driver()
                wait_until(lambda: driver.stop() is None and bool(commands))
        finally:
            halt.set()
            thread.join()
    assert most_mb[0] - before_mb < 100


def test_more_sessions_than_there_are_places_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each session holds fragments in memory. The places are few here; the bus is the real one."""
    monkeypatch.setattr(transport_session, "_MAX_SESSIONS", 3)
    endpoint = free_endpoint()
    client = {"mode": "client", "connect__endpoints": [endpoint], "connect__timeout_ms": 2000}
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))), contextlib.ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(session(**client))
        with pytest.raises(zenoh.ZError):
            stack.enter_context(session(**client))


def test_clients_receive_messages_above_the_limit_of_the_daemon() -> None:
    endpoint, payload = free_endpoint(), bytes(3 << 20)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        received: list[int] = []
        robot.on_message(lambda topic, data, _: received.append(len(data)))
        wait_until(lambda: bus.publish("cloud", payload) is None and len(payload) in received)


def test_idle_connections_do_not_lock_others_out() -> None:
    """Twice as many connections as zenoh accepts by default, none of which sends a byte."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))), contextlib.ExitStack() as stack:
        port = int(endpoint.rpartition(":")[2])
        for _ in range(200):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        with Robot(connect=(endpoint,), timeout_s=5.0) as operator:  # zenoh's own limits: 10 s
            assert operator.alive
