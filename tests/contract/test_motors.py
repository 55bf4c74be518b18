"""What every motor owes its user, over real ptys: it drives, it stops, and no fault of the line moves the wheels."""

from __future__ import annotations

import contextlib
import random
import time
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import LateReplyError, NoReplyError, SerialMotor
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from tests.contract.simulated_motors import (
    ANSWER_S,
    BASE,
    INSTANT,
    LONG_MS,
    NAMES,
    PATIENCE_S,
    connected_motor,
    controller_of,
    shortest_watchdog_ms,
    until,
)

FORWARD = VelocityCommand(0, 0.4, 0.0, 0.0)
ARC = VelocityCommand(0, 0.72, 0.0, 0.9)
SHORT_S = 0.05


@pytest.mark.parametrize("name", NAMES)
def test_drives_turns_and_stops(name: str) -> None:
    with connected_motor(name) as (motor, twin):
        twin.base.limits = INSTANT
        assert until(lambda: motor.send(ARC).watchdog_expired or twin.pose[2] > 0.5)
        x_m, y_m, heading_rad = twin.pose
        assert ((x_m**2 + (y_m - 0.8) ** 2) ** 0.5) == pytest.approx(0.8, rel=0.02)  # a circle of v / w = 0.8 m
        assert twin.base.velocity_mps == pytest.approx(0.72, rel=0.02)
        assert until(lambda: paced(motor).velocity_mps == pytest.approx(0.4, rel=0.2))
        assert twin.pose[2] >= heading_rad
        motor.send(stop_command(0))
        assert until(lambda: twin.base.velocity_mps == twin.base.yaw_rate_radps == 0.0)
        assert twin.errors == 0 and motor.errors == motor.replaced_by_stop == motor.garbage == motor.bad_frames == 0


@pytest.mark.parametrize("name", NAMES)
def test_close_stops_the_wheels(name: str) -> None:
    with connected_motor(name) as (motor, twin):
        motor.send(FORWARD)
        assert twin.base.commanded_mps != [0.0, 0.0]
        motor.close()
        motor.close()
        assert twin.base.commanded_mps == [0.0, 0.0] and not twin.watchdog_expired and twin.errors == 0
        with pytest.raises(DriverError, match="is closed"):
            motor.send(FORWARD)


@pytest.mark.parametrize("name", NAMES)
def test_a_silent_host_is_stopped_and_a_zero_comes_before_motion(name: str) -> None:
    watchdog_ms = shortest_watchdog_ms(name)
    with connected_motor(name, watchdog_ms=watchdog_ms) as (motor, twin):
        motor.send(stop_command(0))
        motor.send(FORWARD)
        assert until(lambda: twin.watchdog_expired and twin.base.velocity_mps == 0.0)
        assert motor.send(FORWARD).watchdog_expired, "told a zero in its place, and says so"
        assert twin.base.commanded_mps == [0.0, 0.0] and motor.replaced_by_stop >= 1
        assert until(lambda: motor.send(FORWARD) is not None and twin.base.commanded_mps != [0.0, 0.0])
        assert twin.base.unsafe_resumes == 0 and twin.errors == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_silent_controller_is_an_error_and_then_a_zero_comes_first(name: str) -> None:
    with connected_motor(name, watchdog_ms=shortest_watchdog_ms(name), timeout_s=SHORT_S) as (motor, twin):
        heard(motor)
        twin.drop_replies = True
        assert until(lambda: type(silence(motor)) is NoReplyError), "late at first, then silent"
        found = silence(motor)
        assert "gave no answer" in str(found) and twin.port in str(found) and "\n" not in str(found)
        twin.drop_replies = False
        assert heard(motor).watchdog_expired and twin.base.commanded_mps == [0.0, 0.0]
        assert until(lambda: heard(motor) is not None and twin.base.commanded_mps != [0.0, 0.0])


@pytest.mark.parametrize("name", NAMES)
def test_an_answer_that_is_late_stops_nothing(name: str) -> None:
    with connected_motor(name, timeout_s=SHORT_S) as (motor, twin):
        assert until(lambda: heard(motor) is not None and twin.base.commanded_mps != [0.0, 0.0])
        twin.drop_replies = True
        found, replaced_by_stop = silence(motor), motor.replaced_by_stop
        assert isinstance(found, LateReplyError) and motor.errors >= 1
        twin.drop_replies = False
        assert not heard(motor).watchdog_expired and twin.base.commanded_mps != [0.0, 0.0]
        assert motor.replaced_by_stop == replaced_by_stop


def silence(motor: SerialMotor) -> DriverError:
    """What is raised for a command that is not answered."""
    with pytest.raises(DriverError) as caught:
        motor.send(FORWARD)
    return caught.value


@pytest.mark.parametrize("name", NAMES)
def test_garbage_is_survived(name: str) -> None:
    rng = random.Random(21)
    with connected_motor(name, timeout_s=SHORT_S) as (motor, twin):
        for _ in range(20):
            twin.garbage = rng.randbytes(rng.randint(1, 40)) + b"\r\n"
            with contextlib.suppress(DriverError):
                motor.send(FORWARD)
        assert motor.garbage + motor.bad_frames + motor.errors > 0
        twin.garbage = b""
        assert until(lambda: heard(motor) is not None and twin.base.commanded_mps != [0.0, 0.0])
        assert twin.errors == 0, "nothing that came back damaged was sent on"


@pytest.mark.parametrize("name", NAMES)
def test_a_stream_without_end_is_an_error(name: str) -> None:
    """A controller that talks without a break and never answers: the deadline holds all the same."""
    with connected_motor(name, timeout_s=SHORT_S) as (motor, twin):
        twin.garbage = b"\xff\xfe{[" * 900
        for _ in range(3):
            with contextlib.suppress(DriverError):
                motor.send(FORWARD)
        twin.garbage = b""
        assert heard(motor) is not None


@pytest.mark.parametrize("name", [name for name in NAMES if name != "ros_arduino_bridge"])  # it tells no voltage
def test_a_late_answer_is_nobodys(name: str) -> None:
    with connected_motor(name) as (motor, twin):
        twin.base.battery_v = 9.5
        late = twin.controller.feed(next(PROTOCOLS[name](BASE).drive(stop_command(0), 0.0)))
        twin.base.battery_v = 12.0
        twin.send(late)
        assert motor._port is not None and until(lambda: motor._port.in_waiting >= len(late))
        assert motor.send(stop_command(0)).battery_v == 12.0


@pytest.mark.parametrize("name", NAMES)
def test_silence_at_connect(name: str) -> None:
    with contextlib.closing(SimulatedMotor(controller_of(name))) as twin:
        twin.drop_input = True
        with pytest.raises(DriverError, match="gave no answer"):
            SerialMotor(twin.port, PROTOCOLS[name](BASE), watchdog_ms=LONG_MS, connect_s=0.1)
        twin.drop_input = False
        SerialMotor(twin.port, PROTOCOLS[name](BASE), watchdog_ms=LONG_MS, connect_s=PATIENCE_S).close()


@pytest.mark.parametrize(("name", "other"), [("line", "roboteq"), ("roboteq", "vesc"), ("vesc", "ros_arduino_bridge")])
def test_another_protocol_is_noticed(name: str, other: str) -> None:
    with contextlib.closing(SimulatedMotor(controller_of(name))) as twin, pytest.raises(DriverError, match="protocol"):
        SerialMotor(twin.port, PROTOCOLS[other](BASE), watchdog_ms=LONG_MS, connect_s=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_an_unplugged_controller_is_an_error_and_comes_back(name: str, tmp_path: Path) -> None:
    port = tmp_path / "motor"
    first = SimulatedMotor(controller_of(name))
    port.symlink_to(first.port)
    motor = SerialMotor(str(port), PROTOCOLS[name](BASE), timeout_s=ANSWER_S, watchdog_ms=LONG_MS)
    with contextlib.closing(motor):
        motor.send(FORWARD)
        port.unlink()
        first.close()
        with pytest.raises(DriverError, match="is gone"):
            motor.send(FORWARD)
        with pytest.raises(DriverError, match=r"no such port|tried again"):
            motor.send(FORWARD)
        with contextlib.closing(SimulatedMotor(controller_of(name))) as second:
            second.expire()  # from now on it complains unless a stop is the first thing told
            port.symlink_to(second.port)
            assert until(lambda: heard(motor) is not None and second.base.commanded_mps != [0.0, 0.0])
            assert motor.connections == 2 and second.errors == 0


@pytest.mark.parametrize("name", NAMES)
def test_the_port_is_for_one_program(name: str) -> None:
    with connected_motor(name) as (_, twin), pytest.raises(DriverError, match="in use by another program"):
        SerialMotor(twin.port, PROTOCOLS[name](BASE), watchdog_ms=LONG_MS)


def paced(motor: SerialMotor) -> MotorStatus:
    """The status after a while: a speed that is a difference of counts needs one."""
    time.sleep(0.05)
    return motor.send(FORWARD)


def heard(motor: SerialMotor, tries: int = 200) -> object:
    """The first status that comes, None where none does; a machine under load may be late with one."""
    for _ in range(tries):
        with contextlib.suppress(DriverError):
            return motor.send(FORWARD)
        time.sleep(0.01)
    return None
