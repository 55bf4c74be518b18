"""Faults of a live robot: the robot drives, a fault comes, its wheels stop, and its daemon goes on or ends in order."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from omnid.core.control.motion_monitor import NOT_COMMANDED, NOT_SEEN
from omnid.core.control.safety_rules import FAILED, POSE_LOST, POSE_STALE
from omnid.transport import codec
from omnid.transport.status_names import STOPPED_PREFIX
from tests.bench.faults.stop_times import FAULTY_DAEMON
from tests.ports import free_port, listening
from tests.replay.live import ROOT, Base, Daemon, Operator, command_line, patient, robot, started
from tests.waiting import PATIENCE_S, wait_until

pytestmark = pytest.mark.slow
WATCH_S = 1.5  # time in which stopped wheels must not turn


class Setting(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


@pytest.fixture
def setting(course: Path, tmp_path: Path) -> Setting:
    (tmp_path / "in").mkdir()
    return Setting(course, tmp_path / "in")


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


NO_IMAGES, FROZEN = "no images of the", "are frozen"


@pytest.mark.parametrize(
    ("line", "part", "word"),
    [
        ("upper mute", "pairing", f"{NO_IMAGES} upper camera"),
        ("lower mute", "pairing", f"{NO_IMAGES} lower camera"),
        ("both mute", "pairing", f"{NO_IMAGES} lower and the upper camera"),
        ("lower garbage", "pairing", "cannot be decoded"),
        ("both cut", "pairing", "cannot be decoded"),
        ("both black", "odometry", "lost"),
        ("upper frozen", "pairing", f"images of the upper camera {FROZEN}"),
        ("both frozen", "pairing", f"images of the lower and the upper camera {FROZEN}"),
    ],
)
def test_a_fault_of_cameras_is_named_and_passes(setting: Setting, line: str, part: str, word: str) -> None:
    with driving(setting, module=FAULTY_DAEMON) as (daemon, operator, base):
        daemon.write_line(line)
        wait_until(lambda: word in operator.message(part), f"'{word}'")
        expect_stop(base)
        daemon.write_line("both ok")
        expect_motion(base)


def test_every_fourth_image_repeated_is_counted_and_it_drives_on(setting: Setting) -> None:
    """A driver that hands out a buffer twice is counted, and the robot drives on."""
    busy = ("--set", "controller.deadlines.pose_s=2.0")  # poses are late on a machine with other jobs
    with driving(setting, *busy, module=FAULTY_DAEMON) as (daemon, operator, _):
        daemon.write_line("upper glitch")
        wait_until(lambda: int(operator.values("pairing").get("repeated_upper", "0")) >= 8, "eight repeated images")
        stops = {f"{STOPPED_PREFIX}{reason}" for reason in (POSE_STALE, POSE_LOST)}
        assert not stops & operator.values("wheels").keys(), operator.values("wheels")


def test_images_of_another_drive_stop_the_wheels(setting: Setting) -> None:
    """The images go to and fro at 0.5 m/s, as if the lens saw a screen, while 0.3 m/s forwards are commanded."""
    words = patient("controller.motion.check=true")
    with driving(setting, *words, module=FAULTY_DAEMON) as (_, operator, base):
        counts = [f"{STOPPED_PREFIX}{reason}" for reason in (NOT_SEEN, NOT_COMMANDED)]
        wait_until(lambda: any(key in operator.values("wheels") for key in counts), "a stop for this reason")
        wait_until(lambda: not base.drives, "wheels that stop although commands arrive")
        operator.stop_sending()  # after two seconds at rest the base would try again
        expect_stop(base)


# The motor controller, its port and the serial line


def test_a_serial_port_is_unplugged_and_back(setting: Setting) -> None:
    """The pty is closed; another one appears under the same name."""
    with driving(setting) as (_, operator, base):
        base.unplug()
        wait_until(lambda: operator.message("wheels") == FAILED, "the error in the status")
        operator.stop_sending()
        time.sleep(1.0)
        base.plug_in()
        wait_until(lambda: len(base.line.notes) > 10, "the first commands to the new motor controller")
        expect_stop(base)
        operator.drive()
        expect_motion(base)


def test_good_answers_are_found_in_serial_garbage(setting: Setting) -> None:
    """Noise before each answer of the motor controller."""
    with driving(setting) as (_, operator, base):
        base.twin.garbage = random.Random(3).randbytes(200) + b"$S,9,9*0000\n"
        since_s = time.monotonic()
        time.sleep(2.0)
        assert base.line.moved_since(since_s), "good answers are found in the noise"
        base.twin.garbage = b""
        operator.stop_sending()
        expect_stop(base)


@pytest.mark.parametrize("noise", [True, False])
def test_a_motor_controller_that_hears_nothing_stops_by_its_watchdog(setting: Setting, noise: bool) -> None:
    """The motor controller hears nothing; its answers are noise, as at a wrong baud rate, or missing."""
    sound = random.Random(6)
    with driving(setting) as (_, operator, base):
        base.twin.drop_input = True
        for _ in range(60 * noise):
            base.twin.send(sound.randbytes(80))
            time.sleep(0.03)
        wait_until(lambda: int(operator.values("wheels").get("errors", 0)) > 3, "errors counted")
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
        operator.stop_sending()
        base.twin.drop_input = False
        expect_stop(base)
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0


def test_garbage_on_the_way_to_the_motor_controller_is_refused(setting: Setting) -> None:
    """Another program writes noise into the port."""
    with driving(setting) as (_, operator, base):
        with open(base.port, "wb", buffering=0) as line:
            line.write(random.Random(4).randbytes(500))
        wait_until(lambda: base.line.base.errors > 100, "the controller's count")
        operator.stop_sending()
        expect_stop(base)


def refused(command: list[str], words: str) -> None:
    """Expect one line of a daemon that must not start."""
    code, err = ended(command)
    assert code == 2 and err.count("\n") == 1 and words in err, err


def test_of_two_daemons_on_one_serial_device_the_second_waits(setting: Setting) -> None:
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
        code, err = second.end()
        assert code == 0 and "in use" in err, err


# The host: its processes, its processor and its clocks


def test_a_sigterm_in_the_middle_of_frames_slows_the_wheels_down(setting: Setting) -> None:
    """Five times, at five moments within the period of the images."""
    for part in range(5):
        with (
            tempfile.TemporaryDirectory(dir=setting.folder) as folder,
            driving(Setting(setting.scene, Path(folder))) as (_, _, base),
        ):
            time.sleep(0.02 * part)
        speeds = [note.wheels_mps[0] for note in base.line.notes if note.wheels_mps[0] > 0]
        assert speeds[-1] < 0.2, "slowed down, not at once"


def test_the_wheels_slow_down_after_a_sigkill(setting: Setting) -> None:
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


def test_a_killed_controller_process_ends_the_daemon(setting: Setting) -> None:
    """The daemon cannot go on without it: systemd starts both again."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        operator.drive()
        expect_motion(base)
        os.kill(daemon.controller_pid, signal.SIGKILL)
        _, err = daemon.process.communicate(timeout=PATIENCE_S)
        assert daemon.process.returncode == 2 and "Traceback" not in err, err
        wait_until(lambda: base.twin.base.watchdog_expired and base.line.base.velocity_mps == 0, "its watchdog's stop")
    assert "controller process" in err


@pytest.mark.parametrize("controller", [True, False])
def test_old_setpoints_are_void_after_a_sleep(setting: Setting, controller: bool) -> None:
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
        operator.drive()
        expect_motion(base)
        assert base.line.base.unsafe_resumes == 0


def test_the_stamps_follow_a_step_of_the_clock(setting: Setting) -> None:
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
            daemon.write_line("clock 0")
            wait_until(lambda: abs(_ahead_s(operator)) < 10, "stamps that are right again")
            expect_motion(base)
        wait_until(lambda: operator.values("clock").get("steps") == "6", "the count of steps")


def _ahead_s(operator: Operator) -> float:
    """Return by how much the newest pose's stamp is ahead of the operator's clock."""
    return operator.poses[-1].stamp_ns * 1e-9 - time.time()


def test_the_clock_of_the_operator_is_another(setting: Setting) -> None:
    """It is an hour behind or ahead: that is refused, and obeyed with the stamps of the robot's own poses."""
    with robot(setting.scene, setting.folder) as (daemon, operator, base):
        for step_s, reason in ((-3600.0, "too old"), (3600.0, "stamp in the future")):
            for _ in range(20):
                operator.send("cmd/heading", codec.heading_cdr(time.time_ns() + round(step_s * 1e9), 0.3, 0.0))
            wait_until(lambda name=f"refused, {reason}": operator.values("wheels").get(name) == "20", "the refusals")
            assert not base.line.moved_since(0.0)
        assert daemon.end()[0] == 0
    with (
        tempfile.TemporaryDirectory(dir=setting.folder) as folder,
        robot(setting.scene, Path(folder)) as (_, operator, base),
    ):
        wait_until(lambda: _repeats_the_stamp(operator) or base.drives, "motion", pause_s=0.05)
        expect_stop(base)


def _repeats_the_stamp(operator: Operator) -> None:
    """Send a setpoint with the stamp of the robot's newest pose."""
    operator.send("cmd/heading", codec.heading_cdr(operator.poses[-1].stamp_ns, 0.3, 0.0))


# The bus, its operators, and their messages


def test_a_bus_port_that_is_taken_is_one_line(setting: Setting) -> None:
    """Another program listens on the port."""
    with contextlib.closing(Base(setting.folder)) as base, listening() as port:
        refused(command_line(setting.scene, port, base.port), "bus.listen")
        assert not base.line.moved_since(0.0)


def test_the_operator_leaves_and_another_one_comes(setting: Setting) -> None:
    """The operator leaves the bus, and another one comes."""
    with driving(setting) as (daemon, operator, base):
        operator.close()
        expect_stop(base)
        with contextlib.closing(Operator(daemon.port)) as another:
            wait_until(lambda: another.poses and another.states, "poses for another one")
            another.drive()
            expect_motion(base)


def test_the_operator_does_not_respond_in_the_middle_of_a_drive(setting: Setting) -> None:
    """Its process is stopped (SIGSTOP) and goes on later: its connection stays, no setpoint comes."""
    with driving(setting) as (daemon, operator, base):
        operator.stop_sending()
        expect_stop(base)
        with commander(daemon.port) as process:
            expect_motion(base)
            process.send_signal(signal.SIGSTOP)
            expect_stop(base)
            count = len(operator.poses)
            wait_until(lambda: len(operator.poses) > count + 10, "poses for the others")
            process.send_signal(signal.SIGCONT)
            expect_motion(base)
        expect_stop(base)


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


def test_a_router_comes_and_goes(setting: Setting) -> None:
    """The daemon is to connect to a peer that is not there, then is, then is gone again."""
    port = free_port()
    words = ("--set", f'bus.connect=["tcp/127.0.0.1:{port}"]')
    with driving(setting, *words) as (_, _, base):
        for _ in range(2):
            with listener(port) as process:
                assert process.stdout is not None and process.stdout.readline().startswith(b"received"), "poses there"
            since_s = time.monotonic()
            time.sleep(1.0)
            assert base.line.moved_since(since_s), "it drives on as its operator commands"


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


def test_a_thousand_malformed_setpoints_move_nothing(setting: Setting) -> None:
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
        operator.drive()
        expect_motion(base)


def test_of_two_daemons_on_one_bus_port_the_second_ends(setting: Setting) -> None:
    """The second is refused before its wheels turn."""
    with driving(setting) as (daemon, _, _), contextlib.closing(Base(setting.folder / "..")) as other:
        refused(command_line(setting.scene, daemon.port, other.port), "bus.listen")
        other.port.unlink()
        assert not other.line.moved_since(0.0)
