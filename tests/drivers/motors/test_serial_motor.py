"""The motor of the line protocol and its twin: as pure state, and over a real pty."""

from __future__ import annotations

import contextlib
import math
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorDriver, MotorStatus, VelocityCommand, is_stop, stop_command
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import T, Transaction
from drivers.motors.protocols.line_protocol import (
    LineProtocol,
    StatusMessage,
    VelocityMessage,
    WatchdogReply,
    WatchdogRequest,
    decode,
    encode,
)
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_line import SimulatedLine
from drivers.motors.simulated.simulated_motor import SimulatedMotor

PATIENCE_S = 20.0  # bounds a wait on a loaded machine; nothing here is measured against it
ANSWER_S = 2.0


def drive(state: SimulatedLine, seconds: float, command: VelocityCommand) -> None:
    """Commands at 20 Hz for a while."""
    for _ in range(round(seconds * 20)):
        assert state.handle(encode(VelocityMessage(state.base.commands, command))) is not None
        state.base.advance(0.05)


def until(condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    return condition()


@pytest.fixture
def twin() -> Iterator[SimulatedMotor]:
    with contextlib.closing(SimulatedMotor()) as twin:
        yield twin


# The twin as pure state


def test_twin_drives_straight() -> None:
    state = SimulatedLine()
    drive(state, 2.0, VelocityCommand(0, 0.5, 0.0, 0.0))
    x_m, y_m, heading_rad = state.base.pose
    assert 0.9 < x_m < 1.0 and y_m == 0.0 and heading_rad == 0.0
    assert state.base.errors == 0 and state.base.commands == 40


@pytest.mark.parametrize("heading_rad", [1.0, -2.0, 3.1, -3.1])
def test_twin_steers_to_the_heading(heading_rad: float) -> None:
    state = SimulatedLine()
    drive(state, 6.0, VelocityCommand(0, 0.2, heading_rad, 0.0))
    assert state.base.pose[2] == pytest.approx(heading_rad, abs=0.01)


def test_twin_crosses_half_a_turn_the_short_way() -> None:
    state = SimulatedLine()
    drive(state, 6.0, VelocityCommand(0, 0.2, 3.0, 0.0))
    before, turned = state.base.pose[2], 0.0
    for _ in range(40):
        drive(state, 0.05, VelocityCommand(0, 0.2, -3.0, 0.0))
        turned += math.remainder(state.base.pose[2] - before, math.tau)
        before = state.base.pose[2]
    assert turned == pytest.approx(math.tau - 6.0, abs=0.05)


def test_twin_without_heading_input_follows_the_yaw_rate() -> None:
    state = SimulatedLine(heading_input=False)
    drive(state, 2.0, VelocityCommand(0, 0.5, 2.0, 0.5))
    x_m, y_m, heading_rad = state.base.pose
    assert heading_rad == pytest.approx(1.0, abs=0.05)
    assert math.hypot(x_m, y_m - 1.0) == pytest.approx(1.0, abs=0.05)  # a circle of radius v / w = 1 m about (0, 1)


def test_stop_does_not_turn_towards_its_heading() -> None:
    state = SimulatedLine()
    drive(state, 4.0, VelocityCommand(0, 0.2, 1.0, 0.0))
    drive(state, 2.0, stop_command(0))
    assert state.base.pose[2] == pytest.approx(1.0, abs=0.01)
    assert state.base.velocity_mps == 0.0 and is_stop(stop_command(7))


def test_watchdog_stops_the_wheels_and_says_so() -> None:
    state = SimulatedLine()
    assert state.handle(encode(WatchdogRequest(200))) == encode(WatchdogReply(200))
    drive(state, 1.0, VelocityCommand(0, 0.5, 0.0, 0.0))
    state.base.advance(0.14)  # with the 0.05 s of the last command
    assert not state.base.watchdog_expired and state.base.velocity_mps == 0.5
    state.base.advance(1.0)
    assert state.base.watchdog_expired and state.base.velocity_mps == 0.0 and state.base.expiries == 1
    answers = [state.handle(encode(VelocityMessage(20 + i, stop_command(0)))) for i in range(2)]
    expired = [a.status.watchdog_expired for a in map(decode, filter(None, answers)) if isinstance(a, StatusMessage)]
    assert expired == [True, False]


def test_noise_does_not_feed_the_watchdog() -> None:
    state = SimulatedLine()
    for _ in range(20):
        state.handle(b"$V,0,100,0,0*0000\n")
        state.base.advance(0.05)
    assert state.base.watchdog_expired and state.base.errors == 20 and state.base.commands == 0


def test_gap_in_seq_is_an_error_but_obeyed() -> None:
    state = SimulatedLine()
    command = VelocityCommand(0, 0.2, 0.0, 0.0)
    for seq, told in ((65535, stop_command(0)), (0, stop_command(0)), (2, command)):
        assert state.handle(encode(VelocityMessage(seq, told))) is not None
    assert state.base.errors == 1 and state.base.last_command.velocity_mps == command.velocity_mps


def test_heading_counts_from_where_the_host_connected() -> None:
    state = SimulatedLine()
    drive(state, 4.0, VelocityCommand(0, 0.0, 1.0, 0.1))
    state.handle(encode(WatchdogRequest(500)))
    answer = decode(state.handle(encode(VelocityMessage(0, stop_command(0)))) or b"")
    assert isinstance(answer, StatusMessage) and answer.status.heading_rad == 0.0
    assert state.base.pose[2] == pytest.approx(1.0, abs=0.01)


def test_twin_survives_any_line() -> None:
    rng, state = random.Random(5), SimulatedLine()
    for _ in range(1000):
        assert state.handle(rng.randbytes(rng.randint(0, 40))) is None
    assert state.base.errors == 1000


@pytest.mark.parametrize("dt_s", [-0.1, math.nan, math.inf, 61.0])
def test_twin_refuses_odd_times(dt_s: float) -> None:
    with pytest.raises(DriverError, match="cannot advance"):
        SimulatedLine().base.advance(dt_s)


# The serial motor and the twin over a pty


def test_commands_arrive_and_are_answered(twin: SimulatedMotor) -> None:
    motor: MotorDriver = SerialMotor(twin.port, timeout_s=ANSWER_S, watchdog_ms=10_000)
    command = VelocityCommand(123, 0.5, 0.0, 0.0)
    assert until(lambda: motor.send(command).velocity_mps == 0.5)
    assert twin.pose[0] > 0.0
    assert twin.last_command == VelocityCommand(0, 0.5, 0.0, 0.0)
    assert motor.send(command) == MotorStatus(0.5, 0.0, 0.0, False, 0, 12.0)
    motor.close()
    assert twin.errors == 0 and twin.base.watchdog_ms == 10_000


def test_many_commands_over_the_end_of_seq(twin: SimulatedMotor) -> None:
    protocol = LineProtocol(DifferentialDrive())
    protocol._seq = 65500
    motor = SerialMotor(twin.port, protocol, timeout_s=ANSWER_S, watchdog_ms=10_000)
    with contextlib.closing(motor):
        for i in range(100):
            motor.send(VelocityCommand(i, 0.001 * i, 0.1 * i, -0.02 * i))
        assert twin.commands == 101 and twin.errors == 0 and motor.garbage == motor.bad_frames == 0


def test_unsendable_command_sends_nothing(twin: SimulatedMotor) -> None:
    with contextlib.closing(SerialMotor(twin.port, timeout_s=ANSWER_S)) as motor:
        before = twin.commands
        with pytest.raises(DriverError, match="velocity is nan"):
            motor.send(VelocityCommand(0, math.nan, 0.0, 0.0))
        assert twin.commands == before
        motor.send(stop_command(0))
        assert twin.commands == before + 1 and twin.errors == 0


@pytest.mark.parametrize(
    ("port", "what"),
    [("/dev/no-such-motor", "no such port"), ("/dev/null", "serial port"), ("/", "serial port"), ("", "port")],
)
def test_open_failure_says_what_to_do(port: str, what: str) -> None:
    with pytest.raises(DriverError, match=what) as caught:
        SerialMotor(port)
    assert f"motor port {port!r} " in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("watchdog_ms", "timeout_s"), [(0, 0.05), (20_000, 0.05), (500, 0.0), (500, math.nan)])
def test_settings_must_make_sense(twin: SimulatedMotor, watchdog_ms: int, timeout_s: float) -> None:
    with pytest.raises(DriverError, match=r"watchdog|timeout"):
        SerialMotor(twin.port, watchdog_ms=watchdog_ms, timeout_s=timeout_s)


class Stubborn(SimulatedLine):
    """A controller that keeps its own watchdog time."""

    def handle(self, line: bytes) -> bytes | None:
        """The answer of the twin, but with 1000 ms in force."""
        answer = super().handle(line)
        return encode(WatchdogReply(1000)) if answer and answer.startswith(b"$A") else answer


def test_watchdog_in_force_is_verified() -> None:
    with (
        contextlib.closing(SimulatedMotor(Stubborn())) as twin,
        pytest.raises(DriverError, match="500 ms asked, 1000 ms in force"),
    ):
        SerialMotor(twin.port, timeout_s=ANSWER_S)


class Stuck(SimulatedLine):
    """A controller whose watchdog never lets go."""

    def _status(self) -> MotorStatus:
        return replace(super()._status(), watchdog_expired=True)


def test_a_watchdog_that_never_lets_go_is_an_error() -> None:
    with contextlib.closing(SimulatedMotor(Stuck())) as twin, pytest.raises(DriverError, match="stays stopped"):
        SerialMotor(twin.port, connect_s=0.1)


class Echo(SimulatedLine):
    """Two crossed wires: what is sent comes back."""

    def handle(self, line: bytes) -> bytes | None:
        """The line itself."""
        return line


def test_echo_is_not_taken_for_an_answer() -> None:
    with contextlib.closing(SimulatedMotor(Echo())) as twin, pytest.raises(DriverError, match="no answer"):
        SerialMotor(twin.port, connect_s=0.1)


class Noisy(SimulatedLine):
    """A controller behind a bad cable: noise and stale answers before each good one."""

    def handle(self, line: bytes) -> bytes | None:
        """The twin's answer behind noise, a broken line and an old status."""
        answer = super().handle(line) or b""
        old_status = encode(StatusMessage(9999, MotorStatus(9.0, 0, 0, True, 9, 9.0)))
        return b"\xff\x00$S,1" + b"$S,9,9*0000\n" + old_status + answer


def test_noise_before_the_answer_is_skipped_and_counted() -> None:
    with (
        contextlib.closing(SimulatedMotor(Noisy())) as twin,
        contextlib.closing(SerialMotor(twin.port, timeout_s=ANSWER_S)) as motor,
    ):
        assert motor.send(stop_command(0)).fault == 0
        assert motor.bad_frames == 3 and motor.garbage == 3 * 6  # connected, stopped, sent


def test_twin_counts_what_is_not_of_the_protocol(twin: SimulatedMotor) -> None:
    descriptor = os.open(twin.port, os.O_RDWR | os.O_NOCTTY)
    os.write(descriptor, b"hello\n$V,1,2,3,4*0000\n" + encode(VelocityMessage(5, stop_command(0))))
    assert until(lambda: twin.commands == 1)
    assert twin.errors == 5 + 1
    os.close(descriptor)


def test_twin_outlives_a_host_that_never_reads(twin: SimulatedMotor) -> None:
    descriptor = os.open(twin.port, os.O_RDWR | os.O_NOCTTY)
    for seq in range(2000):
        os.write(descriptor, encode(VelocityMessage(seq, stop_command(0))))
    assert until(lambda: twin.commands == 2000) and twin.unsent > 0
    os.close(descriptor)


# The protocol's host, without a port


def test_heading_goes_on_where_it_was_after_a_new_connection() -> None:
    """A controller counts from 0 again once its watchdog is set; the robot's heading in odom does not."""
    protocol, twin = LineProtocol(DifferentialDrive()), SimulatedLine()
    told(protocol.connect(500), twin)
    turn(protocol, twin, 1.0)
    assert twin.base.pose[2] == pytest.approx(1.0, abs=0.01)
    told(protocol.connect(500), twin)
    status = turn(protocol, twin, 1.5)
    assert twin.base.pose[2] == pytest.approx(1.5, abs=0.01)
    assert status.heading_rad == pytest.approx(1.5, abs=0.01)


def turn(protocol: LineProtocol, twin: SimulatedLine, heading_rad: float) -> MotorStatus:
    for _ in range(100):
        status = told(protocol.drive(VelocityCommand(0, 0.1, heading_rad, 0.0), 0.0), twin)
        twin.base.advance(0.05)
    return status


def told(script: Transaction[T], twin: SimulatedLine) -> T:
    """What a script returns that needs one answer."""
    try:
        script.send(twin.handle(next(script)) or b"")
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]
    raise AssertionError("it wants more")


class Stalling(SimulatedLine):
    """A controller that stops reading once it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.going_on = threading.Event()
        self.going_on.set()

    def feed(self, data: bytes) -> bytes:
        """The twin's answers, while it goes on."""
        self.going_on.wait(PATIENCE_S)
        return super().feed(data)


def test_a_line_that_takes_no_more_is_an_error_and_close_returns() -> None:
    controller = Stalling()
    with contextlib.closing(SimulatedMotor(controller)) as twin:
        motor = SerialMotor(twin.port, timeout_s=ANSWER_S, watchdog_ms=10_000)
        controller.going_on.clear()
        fill(twin.port)
        with pytest.raises(DriverError, match="gave no answer"):
            motor.send(VelocityCommand(0, 0.5, 0.0, 0.0))
        motor.close()
        controller.going_on.set()
    assert twin.last_command == stop_command(0)


def fill(port: str) -> None:
    """Writes until the kernel takes no more."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(descriptor, b"\n" * 1000)
    os.close(descriptor)
