"""Faults injected into a running daemon, and what became of each: `python -m tests.replay.faults` prints the table.

In each the operator drives, the fault comes, the wheels must come to a stand or go on as asked, and where it can the
daemon recovers by itself. A fault that went wrong raises AssertionError.
"""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from omnid.core.fail_safe import FAILED
from omnid.transport import codec
from tests.replay.live import Base, Daemon, Operator, command_line, free_port, robot, started, wait_until
from tests.scenes import build, write_log

WATCHED_S = 1.5  # for so long wheels are watched that must not turn
SPOILT = "tests.replay.faulty"


class Outcome(NamedTuple):
    """What became of a fault."""

    process: str
    wheels: str
    status: str


class Place(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


Trial = Callable[[Place], Outcome]
TRIALS: dict[str, Trial] = {}


def trial(name: str) -> Callable[[Trial], Trial]:
    """Enters a trial in the table."""

    def enter(run: Trial) -> Trial:
        TRIALS[name] = run
        return run

    return enter


@contextlib.contextmanager
def driving(place: Place, *words: object, module: str = "omnid") -> Iterator[tuple[Daemon, Operator, Base]]:
    """A robot that drives as its operator wants; at the end its daemon lives, and ends with 0."""
    with robot(place.scene, place.folder, *words, module=module) as (daemon, operator, base):
        operator.drive()
        wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion")
        yield daemon, operator, base
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, (code, err)
        assert not base.drives, "the wheels stand at the end"


def stands(base: Base) -> None:
    """The wheels come to a stand and stay so for a while."""
    wait_until(lambda: not base.drives, "the stop")
    wait_until(lambda: base.line.base.velocity_mps == 0, "the stand")
    since_s = time.monotonic()
    time.sleep(WATCHED_S)
    assert not base.line.moved_since(since_s), "the wheels moved unasked"


def goes_on(base: Base) -> None:
    """The wheels turn again."""
    wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion again")


def spoilt(place: Place, line: str, part: str, word: str) -> Outcome:
    """What becomes of pictures that are spoilt for a while."""
    with driving(place, module=SPOILT) as (daemon, operator, base):
        daemon.tell(line)
        wait_until(lambda: word in operator.message(part), f"'{word}'")
        stands(base)
        said = f"{part}: {operator.message(part)}; odometry: {operator.message('odometry')}"
        daemon.tell("both ok")
        goes_on(base)
    return Outcome("alive, recovered by itself", "stopped, turned again with the next command", said)


@trial("upper camera stuck")
def upper_stuck(place: Place) -> Outcome:
    """No more pictures of one camera."""
    return spoilt(place, "upper mute", "pairing", "no pictures of the upper camera")


@trial("lower camera stuck")
def lower_stuck(place: Place) -> Outcome:
    """No more pictures of the other."""
    return spoilt(place, "lower mute", "pairing", "no pictures of the lower camera")


@trial("both cameras stuck")
def both_stuck(place: Place) -> Outcome:
    """No more pictures at all."""
    return spoilt(place, "both mute", "pairing", "no pictures of the lower and the upper camera")


@trial("garbage JPEG")
def garbage(place: Place) -> Outcome:
    """Noise between a JPEG's first and last bytes."""
    return spoilt(place, "lower garbage", "pairing", "cannot be decoded")


@trial("JPEG cut in half")
def cut(place: Place) -> Outcome:
    """Pictures whose end is missing."""
    return spoilt(place, "both cut", "pairing", "cannot be decoded")


@trial("black frames")
def black(place: Place) -> Outcome:
    """The light goes off."""
    return spoilt(place, "both black", "odometry", "lost")


@trial("serial port unplugged and back")
def unplugged(place: Place) -> Outcome:
    """The pty is closed; another one appears under the same name."""
    with driving(place) as (_, operator, base):
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "an error told of the wheels")
        said = f"wheels: {operator.message('wheels')}"
        operator.cease()
        time.sleep(1.0)
        base.plug_in()
        wait_until(lambda: len(base.line.notes) > 10, "the new controller's first commands")
        stands(base)
        operator.drive()
        goes_on(base)
    return Outcome("alive, opened the port again by itself", "watchdog; stood until a fresh command", said)


@trial("serial garbage")
def serial_garbage(place: Place) -> Outcome:
    """Noise before each answer of the controller."""
    with driving(place) as (_, operator, base):
        base.twin.garbage = random.Random(3).randbytes(200) + b"$S,9,9*0000\n"
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s), "good answers are found in the noise"
        said = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        base.twin.garbage = b""
        operator.cease()
        stands(base)
    return Outcome("alive", "drove on as asked, stopped when commands ceased", said)


@trial("nothing but garbage on the serial line")
def only_garbage(place: Place) -> Outcome:
    """The controller's answers are noise, as at a wrong baud rate."""
    noise = random.Random(6)
    with driving(place) as (_, operator, base):
        base.twin.deaf = True
        for _ in range(60):
            base.twin.say(noise.randbytes(80))
            time.sleep(0.03)
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        said = f"wheels: {operator.message('wheels')}"
        assert base.line.base.velocity_mps == 0, "the watchdog's stop"
        operator.cease()
        base.twin.deaf = False
        stands(base)
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a fresh command", said)


@trial("garbage on the way to the controller")
def line_garbage(place: Place) -> Outcome:
    """Another program writes noise into the port."""
    with driving(place) as (_, operator, base):
        with open(base.port, "wb", buffering=0) as line:
            line.write(random.Random(4).randbytes(500))
        wait_until(lambda: base.line.base.errors > 100, "the controller's count")
        said = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        operator.cease()
        stands(base)
    return Outcome("alive", "as asked; the CRC refused the noise", said)


@trial("controller silent, then back")
def silent(place: Place) -> Outcome:
    """The controller neither hears nor answers."""
    with driving(place) as (_, operator, base):
        base.twin.deaf = True
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        wait_until(lambda: base.twin.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
        said = f"wheels: {operator.message('wheels')}"
        operator.cease()
        base.twin.deaf = False
        stands(base)
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a fresh command", said)


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


def ended(command: list[str]) -> tuple[int, str]:
    """Exit code and stderr of a program that ends by itself."""
    with started(command, 0) as daemon:
        _, err = daemon.process.communicate(timeout=60)
        return daemon.process.returncode, err


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
        operator.cease()
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
    root = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", COMMANDER, str(port)], cwd=root) as process:
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
        operator.cease()
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


@trial("SIGTERM in the middle of frames")
def sigterm(place: Place) -> Outcome:
    """Five times, at five moments of a picture."""
    for part in range(5):
        with tempfile.TemporaryDirectory(dir=place.folder) as folder, \
                driving(Place(place.scene, Path(folder))) as (_, _, base):
            time.sleep(0.02 * part)
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("exit 0, five of five", "slowed down to a stand", "")


@trial("host overloaded: SIGSTOP for 2 s")
def stopped(place: Place) -> Outcome:
    """The daemon gets no processor for 2 s while commands go on; then they have ceased."""
    with driving(place) as (daemon, operator, base):
        daemon.process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        assert base.twin.watchdog_expired and not base.drives, "the controller's own watchdog"
        operator.cease()
        time.sleep(0.2)
        since_s = time.monotonic()
        daemon.process.send_signal(signal.SIGCONT)
        wait_until(lambda: float(operator.values("wheels").get("tick_late_max_ms", 0)) > 1500, "its lateness told")
        stands(base)
        assert not base.line.moved_since(since_s + 0.5), "old commands are void"
        reasons = sorted(name for name in operator.values("wheels") if name.startswith("stopped"))
        operator.drive()
        goes_on(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "watchdog; stood until a fresh command", ", ".join(reasons))


@trial("two daemons on one serial device")
def two_daemons(place: Place) -> Outcome:
    """The second is refused; the first drives on."""
    with driving(place) as (_, _, base):
        code, err = ended(command_line(place.scene, free_port(), base.port))
        assert code == 2 and err.count("\n") == 1 and "in use" in err, err
        since_s = time.monotonic()
        time.sleep(0.5)
        assert base.line.moved_since(since_s) and base.line.base.errors == 0
    return Outcome("second: one line, exit 2; first: alive", "as the first's operator asked", err.strip())


@trial("two daemons on one bus port")
def two_voices(place: Place) -> Outcome:
    """The second is refused before its wheels turn."""
    with driving(place) as (daemon, _, _), contextlib.closing(Base(place.folder / "..")) as other:
        code, err = ended(command_line(place.scene, daemon.port, other.port))
        other.port.unlink()
        assert code == 2 and err.count("\n") == 1 and not other.line.moved_since(0.0), err
    return Outcome("second: one line, exit 2; first: alive", "the second's never turned", err.strip())


@trial("clock step of this machine")
def clock_step(place: Place) -> Outcome:
    """The daemon's time of day is an hour ahead, an hour behind, then 30 s ahead, then right again."""
    with driving(place, module=SPOILT) as (daemon, operator, base):
        for step_s in (3600, -3600):
            daemon.tell(f"clock {step_s}")
            time.sleep(0.5)
            goes_on(base)
        daemon.tell("clock 30")
        wait_until(lambda: "refused, sent long ago" in operator.values("wheels"), "the refusals")
        stands(base)
        said = f"wheels: {operator.message('wheels')}; refused: sent long ago"
        daemon.tell("clock 0")
        goes_on(base)
        steps_s = [(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in pairwise(operator.poses)]
        assert min(steps_s) > 0 and max(steps_s) < 20, "stamps of poses are of one clock and one offset"
    return Outcome("alive", "drove on at an hour's step; stopped at 30 s, when commands look old; recovered", said)


@trial("clock of the operator is another")
def another_clock(place: Place) -> Outcome:
    """It is an hour ahead or behind, then 30 s behind."""
    with robot(place.scene, place.folder) as (daemon, operator, base):
        said = []
        for step_s in (3600.0, -3600.0):
            send_until(operator, base, step_s)
            stands(base)
            said.append(f"{step_s:+g} s: driven by their arrival")
        for _ in range(20):
            operator.send("cmd/heading", codec.heading_cdr(time.time_ns() - 30 * 10**9, 0.3, 0.0))
            time.sleep(0.02)
        wait_until(lambda: operator.values("wheels").get("refused, sent long ago") == "20", "the refusals")
        assert not base.drives
        said.append("-30 s: refused as sent long ago, counted")
        assert daemon.end()[0] == 0
    return Outcome("alive", "turned only where stated", "; ".join(said))


def send_until(operator: Operator, base: Base, step_s: float) -> None:
    """Commands with the stamps of another clock, until the wheels turn."""
    deadline_s = time.monotonic() + 30
    while not base.drives:
        assert time.monotonic() < deadline_s
        operator.send("cmd/heading", codec.heading_cdr(time.time_ns() + round(step_s * 1e9), 0.3, 0.0))
        time.sleep(0.05)


def scene(folder: Path) -> Path:
    """A small rendered run."""
    run = build("two_walls", seed=3, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    return folder


def main() -> int:
    """Prints the table as Markdown; 1 where a trial has failed. Words: only the trials whose names hold one of them."""
    wanted = [name for name in TRIALS if not sys.argv[1:] or any(word in name for word in sys.argv[1:])]
    print("| fault | process | wheels | what the status said |\n|---|---|---|---|", flush=True)
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        recorded = scene(Path(name) / "scene")
        for number, fault in enumerate(wanted):
            folder = Path(name) / str(number) / "in"
            folder.mkdir(parents=True)
            try:
                outcome = TRIALS[fault](Place(recorded, folder))
            except AssertionError as error:
                failed += 1
                outcome = Outcome("FAILED", "", " ".join(str(error).split())[:200])
            print(f"| {fault} | {' | '.join(outcome)} |", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
