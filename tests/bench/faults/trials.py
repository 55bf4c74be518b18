"""Faults of a live robot: the robot drives, a fault comes, and the outcome is checked and described."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from omnid.core.control.motion_monitor import NOT_COMMANDED, NOT_SEEN
from omnid.core.control.safety_rules import FAILED, POSE_LOST, POSE_STALE
from omnid.transport import codec
from omnid.transport.status_names import STOPPED_PREFIX
from tests.ports import free_port, listening
from tests.replay.live import ROOT, Base, Daemon, Operator, command_line, patient, robot, started
from tests.waiting import PATIENCE_S, wait_until

WATCH_S = 1.5  # time in which stopped wheels must not turn
FAULTY_DAEMON = "tests.replay.faulty"


class Outcome(NamedTuple):
    """The outcome of a fault, for the table."""

    process: str
    wheels: str
    status: str


class Setting(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


Trial = Callable[[Setting], Outcome]
TRIALS: dict[str, Trial] = {}


def trial(name: str) -> Callable[[Trial], Trial]:
    """Register a trial in the table."""

    def enter(run: Trial) -> Trial:
        TRIALS[name] = run
        return run

    return enter


@contextlib.contextmanager
def driving(setting: Setting, *words: object, module: str = "omnid") -> Iterator[tuple[Daemon, Operator, Base]]:
    """Start a robot that drives; at the end its daemon must still run, and end with exit code 0."""
    with robot(setting.scene, setting.folder, *words, module=module) as (daemon, operator, base):
        operator.drive()
        wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion")
        yield daemon, operator, base
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, (code, err)
        assert not base.drives, "the wheels stop at the end"


def expect_stop(base: Base) -> None:
    """Wait until the wheels stop; they must not turn for WATCH_S after that."""
    wait_until(lambda: not base.drives, "the stop")
    wait_until(lambda: base.line.base.velocity_mps == 0, "standstill")
    since_s = time.monotonic()
    time.sleep(WATCH_S)
    assert not base.line.moved_since(since_s), "the wheels moved without a setpoint"


def expect_motion(base: Base) -> None:
    """Wait until the wheels turn."""
    wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion again")


def ended(command: list[str]) -> tuple[int, str]:
    """Return exit code and stderr of a program that ends by itself."""
    with started(command, 0) as daemon:
        _, err = daemon.process.communicate(timeout=60)
        return daemon.process.returncode, err


# The cameras, whose frames a LogCamera changes


def camera_fault(setting: Setting, line: str, part: str, word: str) -> Outcome:
    """Inject a fault into the images for a while."""
    with driving(setting, module=FAULTY_DAEMON) as (daemon, operator, base):
        daemon.write_line(line)
        wait_until(lambda: word in operator.message(part), f"'{word}'")
        expect_stop(base)
        status = f"{part}: {operator.message(part)}; odometry: {operator.message('odometry')}"
        daemon.write_line("both ok")
        expect_motion(base)
    return Outcome("alive, recovered by itself", "stopped, turned again with the next setpoint", status)


# Fault -> what is injected, the part of the status that names it, and the words in which it does.
NO_IMAGES, FROZEN = "no images of the", "are frozen"
CAMERA_FAULTS: Final = {
    "upper camera stuck": ("upper mute", "pairing", f"{NO_IMAGES} upper camera"),
    "lower camera stuck": ("lower mute", "pairing", f"{NO_IMAGES} lower camera"),
    "both cameras stuck": ("both mute", "pairing", f"{NO_IMAGES} lower and the upper camera"),
    "garbage JPEG": ("lower garbage", "pairing", "cannot be decoded"),
    "JPEG cut in half": ("both cut", "pairing", "cannot be decoded"),
    "black frames": ("both black", "odometry", "lost"),
    "upper camera frozen": ("upper frozen", "pairing", f"images of the upper camera {FROZEN}"),
    "both cameras frozen": ("both frozen", "pairing", f"images of the lower and the upper camera {FROZEN}"),
}
for name, (line, part, word) in CAMERA_FAULTS.items():
    trial(name)(partial(camera_fault, line=line, part=part, word=word))


@trial("every fourth image repeated")
def repeated_now_and_then(setting: Setting) -> Outcome:
    """A driver that hands out a buffer twice is counted, and the robot drives on."""
    busy = ("--set", "controller.deadlines.pose_s=2.0")  # poses are late on a machine with other jobs
    with driving(setting, *busy, module=FAULTY_DAEMON) as (daemon, operator, _):
        daemon.write_line("upper glitch")
        wait_until(lambda: int(operator.values("pairing").get("repeated_upper", "0")) >= 8, "eight repeated images")
        stops = {f"{STOPPED_PREFIX}{reason}" for reason in (POSE_STALE, POSE_LOST)}
        assert not stops & operator.values("wheels").keys(), operator.values("wheels")
        status = f"pairing: {operator.message('pairing')}, repeated_upper counted"
    return Outcome("alive", "drove on as commanded", status)


@trial("images of another drive")
def another_drive(setting: Setting) -> Outcome:
    """The images go to and fro at 0.5 m/s, as if the lens saw a screen, while 0.3 m/s forwards are commanded."""
    words = patient("controller.motion.check=true")
    with driving(setting, *words, module=FAULTY_DAEMON) as (_, operator, base):
        counts = [f"{STOPPED_PREFIX}{reason}" for reason in (NOT_SEEN, NOT_COMMANDED)]
        wait_until(lambda: any(key in operator.values("wheels") for key in counts), "a stop for this reason")
        wait_until(lambda: not base.drives, "wheels that stop although commands arrive")
        operator.stop_sending()  # after two seconds at rest the base would try again
        expect_stop(base)
        status = f"wheels: {operator.message('wheels')}"
    return Outcome("alive", "slowed down, then stopped", status)


# The motor controller, its port and the serial line


@trial("serial port unplugged and back")
def unplugged(setting: Setting) -> Outcome:
    """The pty is closed; another one appears under the same name."""
    with driving(setting) as (_, operator, base):
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "the error in the status")
        status = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        time.sleep(1.0)
        base.plug_in()
        wait_until(lambda: len(base.line.notes) > 10, "the first commands to the new motor controller")
        expect_stop(base)
        operator.drive()
        expect_motion(base)
    return Outcome("alive, opened the port again by itself", "watchdog; stood until a new setpoint", status)


@trial("serial garbage")
def serial_garbage(setting: Setting) -> Outcome:
    """Noise before each answer of the motor controller."""
    with driving(setting) as (_, operator, base):
        base.twin.garbage = random.Random(3).randbytes(200) + b"$S,9,9*0000\n"
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s), "good answers are found in the noise"
        status = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        base.twin.garbage = b""
        operator.stop_sending()
        expect_stop(base)
    return Outcome("alive", "drove on as commanded, stopped when the setpoints ended", status)


def unheard(setting: Setting, *, noise: bool) -> Outcome:
    """The motor controller hears nothing; its answers are noise, as at a wrong baud rate, or missing."""
    sound = random.Random(6)
    with driving(setting) as (_, operator, base):
        base.twin.drop_input = True
        for _ in range(60 * noise):
            base.twin.send(sound.randbytes(80))
            time.sleep(0.03)
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
        status = f"wheels: {operator.message('wheels')}"
        operator.stop_sending()
        base.twin.drop_input = False
        expect_stop(base)
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "its watchdog stopped them; stood until a new setpoint", status)


trial("nothing but garbage on the serial line")(partial(unheard, noise=True))
trial("motor controller does not answer, then does")(partial(unheard, noise=False))


@trial("garbage on the way to the motor controller")
def line_garbage(setting: Setting) -> Outcome:
    """Another program writes noise into the port."""
    with driving(setting) as (_, operator, base):
        with open(base.port, "wb", buffering=0) as line:
            line.write(random.Random(4).randbytes(500))
        wait_until(lambda: base.line.base.errors > 100, "the controller's count")
        status = f"wheels: {operator.message('wheels')}, errors {operator.values('wheels')['errors']}"
        operator.stop_sending()
        expect_stop(base)
    return Outcome("alive", "as commanded; the CRC refused the noise", status)


def refused(command: list[str], words: str) -> str:
    """Return the line of a daemon that must not start."""
    code, err = ended(command)
    assert code == 2 and err.count("\n") == 1 and words in err, err
    return err.strip()


@trial("two daemons on one serial device")
def two_daemons(setting: Setting) -> Outcome:
    """The second waits for its motor controller; the first drives on."""
    port = free_port()
    with (
        driving(setting) as (_, _, base),
        started(command_line(setting.scene, port, base.port), port) as second,
        contextlib.closing(Operator(port)) as watcher,
    ):
        wait_until(lambda: watcher.states, "its status")
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s) and base.line.base.errors == 0
        status = f"wheels: {watcher.message('wheels')}"
        code, err = second.end()
        assert code == 0 and "in use" in err, err
    return Outcome("second: warns and waits; first: alive", "as the first's operator commanded", status)


# The host: its processes, its processor and its clocks


@trial("SIGTERM in the middle of frames")
def sigterm(setting: Setting) -> Outcome:
    """Five times, at five moments within the period of the images."""
    for part in range(5):
        with (
            tempfile.TemporaryDirectory(dir=setting.folder) as folder,
            driving(Setting(setting.scene, Path(folder))) as (_, _, base),
        ):
            time.sleep(0.02 * part)
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("exit 0, five of five", "slowed down to a stop", "")


@trial("daemon killed (SIGKILL)")
def killed(setting: Setting) -> Outcome:
    """The controller process goes on alone."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        operator.drive()
        expect_motion(base)
        controller_pid = daemon.controller_pid
        daemon.process.kill()
        expect_stop(base)
        wait_until(lambda: not Path(f"/proc/{controller_pid}").exists(), "its end")
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"
    return Outcome("gone; the controller process ended by itself", "slowed down to a stop", "")


@trial("controller process killed")
def controller_killed(setting: Setting) -> Outcome:
    """The daemon cannot go on without it: systemd starts both again."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        operator.drive()
        expect_motion(base)
        os.kill(daemon.controller_pid, signal.SIGKILL)
        _, err = daemon.process.communicate(timeout=PATIENCE_S)
        assert daemon.process.returncode == 2 and "Traceback" not in err, err
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
    status = next(line for line in err.splitlines() if "controller process" in line)
    return Outcome("one line, exit 2", "the motor controller's watchdog", status)


def asleep(setting: Setting, *, controller: bool) -> Outcome:
    """The daemon gets no processor while setpoints go on, or neither it nor its controller process does."""
    with driving(setting) as (daemon, operator, base):
        processes = [daemon.process.pid, *([daemon.controller_pid] if controller else [])]
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        expect_stop(base)
        assert base.twin.base.watchdog_expired == controller, "the motor controller's watchdog, or the process's stop"
        operator.stop_sending()
        time.sleep(0.2)
        since_s = time.monotonic()
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
        if controller:
            wait_until(lambda: float(operator.values("wheels").get("tick_late_max_ms", 0)) > 1500, "the lateness")
        else:
            wait_until(lambda: f"stopped, {POSE_STALE}" in operator.values("wheels"), "the reason in the status")
        expect_stop(base)
        assert not base.line.moved_since(since_s + 0.5), "old setpoints are void"
        reasons = sorted(name for name in operator.values("wheels") if name.startswith("stopped"))
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0
    return Outcome("alive", "stopped; stood until a new setpoint", ", ".join(reasons))


trial("daemon stuck for 3 s (SIGSTOP)")(partial(asleep, controller=False))
trial("host overloaded: nothing of it runs for 2 s (SIGSTOP)")(partial(asleep, controller=True))


@trial("clock step of this machine")
def clock_step(setting: Setting) -> Outcome:
    """The daemon's time of day is an hour ahead, an hour behind, then 30 s ahead, each time right again after that.

    The operator's is not set: its setpoints look old, or of the future, which a stream that goes on may be.
    """
    with driving(setting, module=FAULTY_DAEMON) as (daemon, operator, base):
        for step_s in (3600, -3600, 30):
            daemon.write_line(f"clock {step_s}")
            wait_until(lambda step_s=step_s: abs(_ahead_s(operator) - step_s) < 10, "stamps that follow")
            if step_s > 0:
                wait_until(lambda: "refused, too old" in operator.values("wheels"), "the refusals")
                expect_stop(base)
            status = f"clock: {operator.message('clock')}; wheels: {operator.message('wheels')}"
            daemon.write_line("clock 0")
            wait_until(lambda: abs(_ahead_s(operator)) < 10, "stamps that are right again")
            expect_motion(base)
        wait_until(lambda: operator.values("clock").get("steps") == "6", "the count of steps")
    return Outcome("alive", "stopped where setpoints look old; recovered; stamps follow", status)


def _ahead_s(operator: Operator) -> float:
    """Return by how much the newest pose's stamp is ahead of the operator's clock."""
    return operator.poses[-1].stamp_ns * 1e-9 - time.time()


@trial("clock of the operator is another")
def another_clock(setting: Setting) -> Outcome:
    """It is an hour behind or ahead: that is refused, and obeyed with the stamps of the robot's own poses."""
    steps_s, status = (-3600.0, 3600.0), []
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        for step_s, reason in zip(steps_s, ("too old", "stamp in the future"), strict=True):
            for _ in range(20):
                operator.send("cmd/heading", codec.heading_cdr(time.time_ns() + round(step_s * 1e9), 0.3, 0.0))
            wait_until(lambda name=f"refused, {reason}": operator.values("wheels").get(name) == "20", "the refusals")
            assert not base.line.moved_since(0.0)
            status.append(f"{step_s:+g} s: refused as {reason!r}, counted")
        assert daemon.end()[0] == 0
    with (
        tempfile.TemporaryDirectory(dir=setting.folder) as folder,
        robot(setting.scene, Path(folder)) as (_, operator, base),
    ):
        wait_until(lambda: _repeats_the_stamp(operator) or base.drives, "motion", pause_s=0.05)
        expect_stop(base)
        status.append("with the stamp of the newest pose: driven")
    return Outcome("alive", "turned only where stated", "; ".join(status))


def _repeats_the_stamp(operator: Operator) -> None:
    """Send a setpoint with the stamp of the robot's newest pose."""
    operator.send("cmd/heading", codec.heading_cdr(operator.poses[-1].stamp_ns, 0.3, 0.0))


# The bus, its operators, and their messages


@trial("bus port taken at the start")
def port_taken(setting: Setting) -> Outcome:
    """Another program listens on the port."""
    with contextlib.closing(Base(setting.folder)) as base, listening() as port:
        line = refused(command_line(setting.scene, port, base.port), "bus.listen")
        assert not base.line.moved_since(0.0)
    return Outcome("one line, exit 2", "never turned", line)


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
        line = refused(command_line(setting.scene, daemon.port, other.port), "bus.listen")
        other.port.unlink()
        assert not other.line.moved_since(0.0)
    return Outcome("second: one line, exit 2; first: alive", "the second's never turned", line)
