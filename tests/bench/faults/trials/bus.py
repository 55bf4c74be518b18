"""Faults of the bus, of its operators, and of their messages."""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

from omnid.transport import codec
from tests.bench.faults.trials.trial import Outcome, Setting, driving, ended, expect_motion, expect_stop, trial
from tests.ports import free_port, listening
from tests.replay.live import ROOT, Base, Operator, command_line
from tests.waiting import wait_until


@trial("bus port taken at the start")
def port_taken(setting: Setting) -> Outcome:
    """Another program listens on the port."""
    with contextlib.closing(Base(setting.folder)) as base, listening() as port:
        code, err = ended(command_line(setting.scene, port, base.port))
        assert code == 2 and err.count("\n") == 1 and "bus.listen" in err, err
        assert not base.line.moved_since(0.0)
    return Outcome("one line, exit 2", "never turned", err.strip())


@trial("operator's peer gone and back")
def peer_gone(setting: Setting) -> Outcome:
    """The operator leaves the bus, and another one comes."""
    with driving(setting) as (daemon, operator, base):
        operator.close()
        expect_stop(base)
        with contextlib.closing(Operator(daemon.port)) as another:
            wait_until(lambda: another.poses and another.states, "poses for another one")
            status = f"wheels: {another.message('wheels')}"
            another.drive()
            expect_motion(base)
    return Outcome("alive", "stopped; turned for the next operator", status)


@trial("operator does not respond in the middle of a drive")
def peer_hangs(setting: Setting) -> Outcome:
    """Its process is stopped (SIGSTOP) and goes on later: its connection stays, no setpoint comes."""
    with driving(setting) as (daemon, operator, base):
        operator.stop_sending()
        expect_stop(base)
        with commander(daemon.port) as process:
            expect_motion(base)
            process.send_signal(signal.SIGSTOP)
            expect_stop(base)
            status = f"wheels: {operator.message('wheels')}"
            count = len(operator.poses)
            wait_until(lambda: len(operator.poses) > count + 10, "poses for the others")
            process.send_signal(signal.SIGCONT)
            expect_motion(base)
        expect_stop(base)
    return Outcome("alive, others still received poses", "stopped; turned when setpoints came again", status)


COMMANDER = """
import sys, time
from tests.replay.live import Operator
operator = Operator(int(sys.argv[1]))
operator.drive()
time.sleep(600)
"""


@contextlib.contextmanager
def commander(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start an operator in a process of its own."""
    with subprocess.Popen([sys.executable, "-c", COMMANDER, str(port)], cwd=ROOT) as process:
        try:
            yield process
        finally:
            process.kill()


@trial("router gone and back")
def router_gone(setting: Setting) -> Outcome:
    """The daemon is to connect to a peer that is not there, then is, then is gone again."""
    port = free_port()
    words = ("--set", f'bus.connect=["tcp/127.0.0.1:{port}"]')
    with driving(setting, *words) as (_, operator, base):
        for _ in range(2):
            with listener(port) as process:
                assert process.stdout is not None and process.stdout.readline().startswith(b"received"), "poses there"
            since_s = time.monotonic()
            time.sleep(1.0)
            assert base.line.moved_since(since_s), "it drives on as its operator commands"
        status = f"wheels: {operator.message('wheels')}"
    return Outcome("alive, connected again by itself", "as commanded all the time", status)


LISTENER = """
import json, sys, threading, zenoh
config = zenoh.Config()
config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{sys.argv[1]}"]))
config.insert_json5("scouting/multicast/enabled", "false")
received = threading.Event()
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("omnid/odom", lambda sample: received.set())
    received.wait()
    print("received", flush=True)
    threading.Event().wait()
"""


@contextlib.contextmanager
def listener(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a peer that listens, and kill it at the end."""
    command = [sys.executable, "-c", LISTENER, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


@trial("1,000 malformed setpoints at full speed")
def malformed(setting: Setting) -> Outcome:
    """Random bytes, cut messages, NaN, absurd numbers, on both keys, while a good operator drives."""
    rng = random.Random(5)
    good = codec.twist_stamped_cdr(time.time_ns(), "base_link", 0.5, 1.0)
    with driving(setting) as (_, operator, base):
        operator.stop_sending()
        expect_stop(base)
        since_s = time.monotonic()
        accepted = int(operator.values("wheels")["commands"])
        for number in range(1000):
            kind = number % 4
            payload = (
                rng.randbytes(rng.randrange(200)),
                good[: rng.randrange(len(good))],
                codec.heading_cdr(time.time_ns(), float("nan"), 0.0),
                codec.heading_cdr(time.time_ns(), 1e9, 0.0),
            )
            operator.send("cmd/heading" if kind > 1 else rng.choice(("cmd/heading", "cmd/twist")), payload[kind])

        def refused() -> int:
            values = operator.values("wheels")
            return sum(int(count) for name, count in values.items() if name.startswith("refused"))

        wait_until(lambda: refused() == 1000, "all of them counted")
        assert not base.line.moved_since(since_s) and int(operator.values("wheels")["commands"]) == accepted
        counts = {name: count for name, count in operator.values("wheels").items() if name.startswith("refused")}
        operator.drive()
        expect_motion(base)
    return Outcome("alive", "never turned by one of them", ", ".join(f"{k}: {v}" for k, v in sorted(counts.items())))


@trial("two daemons on one bus port")
def two_daemons_on_one_bus(setting: Setting) -> Outcome:
    """The second is refused before its wheels turn."""
    with driving(setting) as (daemon, _, _), contextlib.closing(Base(setting.folder / "..")) as other:
        code, err = ended(command_line(setting.scene, daemon.port, other.port))
        other.port.unlink()
        assert code == 2 and err.count("\n") == 1 and not other.line.moved_since(0.0), err
    return Outcome("second: one line, exit 2; first: alive", "the second's never turned", err.strip())
