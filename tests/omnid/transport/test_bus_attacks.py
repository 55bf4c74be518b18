"""Attacks on the bus by programs that may connect and may not command: real sessions on this machine."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from omnid.client import Robot
from omnid.transport import session as transport_session
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import ERROR, OK, WARN
from omnid.transport.intake import UNKNOWN, budget_of
from omnid.transport.requests import Request
from omnid.transport.topics import command_topics
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, odometry, script, wait_until


@contextlib.contextmanager
def session(**settings: object) -> Iterator[zenoh.Session]:
    """Open a zenoh session; double underscores in the names stand for slashes."""
    config = zenoh.Config()
    defaults = {"scouting__multicast__enabled": False, "transport__shared_memory__enabled": False}
    for key, value in (defaults | settings).items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    opened = zenoh.open(config)
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]


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


def test_starts_disarmed_beside_a_robot_of_the_same_name() -> None:
    router = free_endpoint()
    with script(ROUTER, router), contextlib.ExitStack() as stack:
        first = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(), connect=(router,)))))
        warnings, commands = list[str](), list[str]()
        second = stack.enter_context(contextlib.closing(Bus(BusConfig(listen=(), connect=(router,)), warnings.append)))
        assert len(warnings) == 1 and "change bus.robot" in warnings[0] and "\n" not in warnings[0]
        second.subscribe_commands(lambda request: commands.append(request.topic), {})
        assert second.status().level == ERROR and not second.is_unique and commands == ["cmd/stop"]
        with contextlib.closing(Bus(BusConfig(robot="other", listen=(), connect=(router,)))) as other:
            assert other.status().level == first.status().level == OK
        first.close()
        wait_until(lambda: second.status().level == OK and second.is_unique)


@pytest.mark.parametrize("token", ["omnid/alive", "omnid/alive/x"])
def test_a_token_of_a_stranger_keeps_no_robot_from_starting(token: str) -> None:
    """It may keep the robot disarmed, and the status says so, where no user needs a password."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with session(mode="client", connect__endpoints=[endpoint]) as stranger:
            held = stranger.liveliness().declare_token(token)
            if token.endswith("x"):
                wait_until(lambda: bus.status().level == ERROR)
                wait_until(lambda: commands == ["cmd/stop"])
            else:
                stranger.put("omnid/cmd/mark", b"")
                wait_until(lambda: commands == ["cmd/mark"])
                assert bus.is_unique
            del held
        wait_until(lambda: bus.status().level == OK)


def test_with_users_only_the_robot_declares_tokens_below_its_name(tmp_path: Path) -> None:
    endpoint, users = free_endpoint(), tmp_path / "users"
    users.write_text("eve:secret\n")
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), users_file=str(users)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with session(
            mode="client",
            connect__endpoints=[endpoint],
            transport__auth__usrpwd__user="eve",
            transport__auth__usrpwd__password="secret",
        ) as stranger:
            held = stranger.liveliness().declare_token("omnid/alive/x")
            stranger.put("omnid/cmd/mark", b"")
            wait_until(lambda: commands == ["cmd/mark"])
            assert bus.is_unique and bus.status().level == OK
            replies = list(stranger.liveliness().get("omnid/alive"))
            assert len(replies) == 1, "that of the robot is still seen"
            del held


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


@pytest.mark.parametrize("key", ["cmd/imu", "cmd/route", "cmd/arm", "cmd/nothing", "@request/arm", "@request/path"])
def test_a_flood_on_one_key_is_bounded_and_keeps_no_other_key_out(key: str) -> None:
    """Of the flood no more than the budget is passed on; a stop and a command on another key get through."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: Counter[str] = Counter()

        def count(request: Request) -> None:
            commands[request.topic] += 1

        bus.subscribe_commands(count, command_topics(("operator",)))
        with script(FLOOD, endpoint, f"omnid/{key}"), Robot(connect=(endpoint,)) as operator:
            driver = operator.driver()
            wait_until(lambda: bus.status().level == WARN)
            assert any(name.startswith("flooded, ") for name in bus.status().values)
            topic = key.replace("@request", "cmd")
            begin_s, before = time.monotonic(), commands[topic]
            wait_until(lambda: driver.stop() is None and commands["cmd/stop"] > 0)
            wait_until(lambda: driver.twist(0.1, 0.0) is None and commands["cmd/twist"] > 0)
            time.sleep(1.0)
            budget = UNKNOWN if key == "cmd/nothing" else budget_of(topic)
            most = 2 * budget.burst + budget.rate_hz * (time.monotonic() - begin_s)
            assert commands[topic] - before <= most


def test_warns_once_of_a_robot_of_the_same_name_that_appears_later() -> None:
    """Two robots start as clients without a router, which connects them later."""
    router, warnings = free_endpoint(), list[str]()
    with contextlib.ExitStack() as stack:
        first, second = (
            stack.enter_context(contextlib.closing(Bus(BusConfig(mode="client", connect=(router,)), warnings.append)))
            for _ in range(2)
        )
        connection = stack.enter_context(script(ROUTER, router))
        wait_until(
            lambda: (
                bool([bus.connect() for bus in (first, second)])
                and first.status().level == second.status().level == ERROR
            )
        )
        assert "bus.robot" in first.status().message and first.status().values["same_name"] == "1"
        assert len(warnings) == 2
        connection.kill()
        wait_until(lambda: first.status().level == second.status().level == OK)
        assert len(warnings) == 2, "each warns once"
