"""Faults of the bus, of those who command over it, and of what they say."""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

from omnid.transport import codec
from tests.replay.faults.trial import Outcome, Place, driving, ended, goes_on, stands, trial
from tests.replay.live import ROOT, Base, Operator, command_line, free_port, wait_until


@trial("bus port taken at the start")
def port_taken(place: Place) -> Outcome:
    """Another program listens there."""
    with contextlib.closing(Base(place.folder)) as base, driving_nothing() as port:
        code, err = ended(command_line(place.scene, port, base.port))
        assert code == 2 and err.count("\n") == 1 and "bus.listen" in err, err
        assert not base.line.moved_since(0.0)
    return Outcome("one line, exit 2", "never turned", err.strip())


@contextlib.contextmanager
def driving_nothing() -> Iterator[int]:
    """A port on which somebody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield int(server.getsockname()[1])


@trial("operator's peer gone and back")
def peer_gone(place: Place) -> Outcome:
    """The one who commands leaves the bus, and another one comes."""
    with driving(place) as (daemon, operator, base):
        operator.close()
        stands(base)
        with contextlib.closing(Operator(daemon.port)) as another:
            wait_until(lambda: another.poses and another.states, "poses for another one")
            said = f"wheels: {another.message('wheels')}"
            another.drive()
            goes_on(base)
    return Outcome("alive", "stopped; turned for the next operator", said)


@trial("operator hangs in the middle of a drive")
def peer_hangs(place: Place) -> Outcome:
    """Its process is stopped (SIGSTOP) and goes on later: its connection stays, nothing comes."""
    with driving(place) as (daemon, operator, base):
        operator.stop_sending()
        stands(base)
        with commander(daemon.port) as process:
            goes_on(base)
            process.send_signal(signal.SIGSTOP)
            stands(base)
            said = f"wheels: {operator.message('wheels')}"
            count = len(operator.poses)
            wait_until(lambda: len(operator.poses) > count + 10, "poses for the others")
            process.send_signal(signal.SIGCONT)
            goes_on(base)
        stands(base)
    return Outcome("alive, others went on hearing poses", "stopped; turned when commands came again", said)


COMMANDER = """
import sys, time
from tests.replay.live import Operator
operator = Operator(int(sys.argv[1]))
operator.drive()
time.sleep(600)
"""


@contextlib.contextmanager
def commander(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """An operator in a process of its own."""
    with subprocess.Popen([sys.executable, "-c", COMMANDER, str(port)], cwd=ROOT) as process:
        try:
            yield process
        finally:
            process.kill()


@trial("router gone and back")
def router_gone(place: Place) -> Outcome:
    """The daemon is to connect to a peer that is not there, then is, then is gone again."""
    port = free_port()
    words = ("--set", f'bus.connect=["tcp/127.0.0.1:{port}"]')
    with driving(place, *words) as (_, operator, base):
        for _ in range(2):
            with listener(port) as process:
                assert process.stdout is not None and process.stdout.readline().startswith(b"heard"), "poses there"
            since_s = time.monotonic()
            time.sleep(1.0)
            assert base.line.moved_since(since_s), "it drives on as the operator beside it wants"
        said = f"wheels: {operator.message('wheels')}"
    return Outcome("alive, connected again by itself", "as asked all the time", said)


LISTENER = """
import json, sys, threading, zenoh
config = zenoh.Config()
config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{sys.argv[1]}"]))
config.insert_json5("scouting/multicast/enabled", "false")
heard = threading.Event()
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("omnid/odom", lambda sample: heard.set())
    heard.wait()
    print("heard", flush=True)
    threading.Event().wait()
"""


@contextlib.contextmanager
def listener(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """A peer that listens, and is killed."""
    command = [sys.executable, "-c", LISTENER, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


@trial("1,000 malformed setpoints at full speed")
def malformed(place: Place) -> Outcome:
    """Random bytes, cut messages, NaN, absurd numbers, on both keys, while a good operator drives."""
    rng = random.Random(5)
    good = codec.twist_stamped_cdr(time.time_ns(), "base_link", 0.5, 1.0)
    with driving(place) as (_, operator, base):
        operator.stop_sending()
        stands(base)
        since_s = time.monotonic()
        accepted = int(operator.values("wheels")["commands"])
        for number in range(1000):
            kind = number % 4
            payload = (rng.randbytes(rng.randrange(200)), good[: rng.randrange(len(good))],
                       codec.heading_cdr(time.time_ns(), float("nan"), 0.0),
                       codec.heading_cdr(time.time_ns(), 1e9, 0.0))
            operator.send("cmd/heading" if kind > 1 else rng.choice(("cmd/heading", "cmd/twist")), payload[kind])

        def refused() -> int:
            values = operator.values("wheels")
            return sum(int(count) for name, count in values.items() if name.startswith("refused"))

        wait_until(lambda: refused() == 1000, "all of them counted")
        assert not base.line.moved_since(since_s) and int(operator.values("wheels")["commands"]) == accepted
        counts = {name: count for name, count in operator.values("wheels").items() if name.startswith("refused")}
        operator.drive()
        goes_on(base)
    return Outcome("alive", "never turned by one of them", ", ".join(f"{k}: {v}" for k, v in sorted(counts.items())))


@trial("two daemons on one bus port")
def two_voices(place: Place) -> Outcome:
    """The second is refused before its wheels turn."""
    with driving(place) as (daemon, _, _), contextlib.closing(Base(place.folder / "..")) as other:
        code, err = ended(command_line(place.scene, daemon.port, other.port))
        other.port.unlink()
        assert code == 2 and err.count("\n") == 1 and not other.line.moved_since(0.0), err
    return Outcome("second: one line, exit 2; first: alive", "the second's never turned", err.strip())
