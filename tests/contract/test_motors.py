"""Requirements on every motor driver, directly and over real ptys: it drives, it stops, no fault moves the wheels."""

from __future__ import annotations

import contextlib
import math
import random
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors.protocols.motor_protocol import DifferentialDrive, Framer, MotorProtocol, NoReplyError
from drivers.motors.serial_motor import PROTOCOLS, LateReplyError, SerialMotor
from tests.contract.simulated_controllers import (
    BASE,
    LONG_MS,
    NAMES,
    REPLY_S,
    SHORT_MS,
    PtyMotor,
    SimulatedController,
    connected_motor,
    controller_of,
    run,
    until,
)

WIRINGS = [
    BASE,
    replace(BASE, reverse_right=True),
    replace(BASE, reverse_left=True, swapped=True),
    replace(BASE, swapped=True, can_id=200),
]


class Connection:
    """A protocol connected to its simulated controller; a tick is 50 ms."""

    def __init__(self, name: str, drive: DifferentialDrive = BASE) -> None:
        self.protocol: MotorProtocol = PROTOCOLS[name](drive)
        self.controller: SimulatedController = controller_of(name, drive)
        self.base = self.controller.base
        self.framer: Framer = self.protocol.framer()
        run(self.protocol.connect(LONG_MS), self.controller, self.framer)
        self.send(stop_command(0))

    def send(self, command: VelocityCommand) -> MotorStatus:
        return run(self.protocol.drive(command), self.controller, self.framer)

    def drive(self, seconds: float, velocity_mps: float, yaw_rate_radps: float) -> MotorStatus:
        for _ in range(round(seconds / 0.05)):
            status = self.send(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
            self.base.advance(0.05)
        return status


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drive", WIRINGS)
def test_the_base_drives_the_commanded_arc_and_reports_it(name: str, drive: DifferentialDrive) -> None:
    connection = Connection(name, drive)
    connection.drive(1.0, 0.4, 0.5)
    before = connection.base.pose
    status = connection.drive(2.0, 0.4, 0.5)
    chord_m = math.dist(before[:2], connection.base.pose[:2])
    assert chord_m == pytest.approx(2 * 0.8 * math.sin(0.5), rel=0.01)  # a turn of 1 rad at a radius of 0.8 m
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.4, 0.5), rel=0.02)
    assert not status.watchdog_expired and status.fault == 0
    assert status.battery_v == 12.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("velocity_mps", "yaw_rate_radps"), [(8.0, 4.0), (-3.0, 2.0), (0.9, -4.0), (0.0, 50.0)])
def test_limiting_the_wheel_speed_keeps_the_curvature(name: str, velocity_mps: float, yaw_rate_radps: float) -> None:
    connection = Connection(name)
    connection.send(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
    received = connection.base.last_command
    assert max(map(abs, connection.base.commanded_mps)) == pytest.approx(BASE.max_wheel_mps, rel=0.01)
    assert received.velocity_mps * yaw_rate_radps == pytest.approx(received.yaw_rate_radps * velocity_mps, abs=0.05)
    assert connection.base.errors == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["velocity_mps", "yaw_rate_radps", "heading_rad"])
def test_numbers_that_are_not_finite_are_refused(name: str, bad: float, field: str) -> None:
    command = replace(VelocityCommand(0, 0.1, 0.1, 0.1), **{field: bad})
    with pytest.raises(DriverError, match="only finite"):
        next(PROTOCOLS[name](BASE).drive(command))


@pytest.mark.parametrize("name", NAMES)
def test_host_accepts_any_bytes(name: str) -> None:
    """No bytes raise anything but DriverError."""
    rng, protocol = random.Random(11), PROTOCOLS[name](BASE)
    for noise in noises(rng, replies_of(name)):
        for transaction in (protocol.connect(LONG_MS), protocol.drive(stop_command(0))):
            framer = protocol.framer()
            next(transaction)
            with contextlib.suppress(DriverError, StopIteration):
                for frame in framer.feed(noise):
                    transaction.send(frame)


@pytest.mark.parametrize("name", NAMES)
def test_noise_without_end_needs_bounded_memory(name: str) -> None:
    rng, framer = random.Random(13), PROTOCOLS[name](BASE).framer()
    streams = [rng.randbytes(4096).replace(b"\n", b"x").replace(b"\r", b"x"), b"\x03\x01\xff" * 1000, b"$" * 4096]
    tracemalloc.start()
    for _ in range(5):
        for stream in streams:
            framer.feed(stream)
    used_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used_bytes < 50_000


def replies_of(name: str) -> bytes:
    """Return the replies of the simulated controller to a stop."""
    connection = Connection(name)
    return connection.controller.feed(next(connection.protocol.drive(stop_command(0))))


def noises(rng: random.Random, valid: bytes) -> Iterator[bytes]:
    """Yield random bytes, and valid ones with a flipped bit or with pieces moved."""
    for _ in range(150):
        yield rng.randbytes(rng.randint(0, 60)) + b"\r\n"
    for _ in range(150):
        damaged = bytearray(valid)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        yield bytes(damaged)
        start, end = sorted(rng.sample(range(len(valid)), 2))
        yield valid[start:end] + valid[:start] + b"\n"


FORWARD = VelocityCommand(0, 0.4, 0.0, 0.0)
SHORT_S = 0.05


@pytest.mark.parametrize("name", NAMES)
def test_close_stops_the_wheels(name: str) -> None:
    with connected_motor(name) as (motor, simulated):
        motor.send(FORWARD)
        assert simulated.base.commanded_mps != [0.0, 0.0]
        motor.close()
        motor.close()
        assert (
            simulated.base.commanded_mps == [0.0, 0.0]
            and not simulated.base.watchdog_expired
            and simulated.base.errors == 0
        )
        with pytest.raises(DriverError, match="is closed"):
            motor.send(FORWARD)


@pytest.mark.hazard("H40")
@pytest.mark.parametrize("name", NAMES)
def test_watchdog_stops_a_late_host_and_a_stop_comes_before_motion(name: str) -> None:
    watchdog_ms = SHORT_MS
    with connected_motor(name, watchdog_ms=watchdog_ms) as (motor, simulated):
        motor.send(stop_command(0))
        motor.send(FORWARD)
        assert until(lambda: simulated.base.watchdog_expired and simulated.base.velocity_mps == 0.0)
        assert motor.send(FORWARD).watchdog_expired, "sends a stop instead, and reports it"
        assert simulated.base.commanded_mps == [0.0, 0.0] and motor.replaced_by_stop >= 1
        assert until(lambda: motor.send(FORWARD) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        assert simulated.base.unsafe_resumes == 0 and simulated.base.errors == 0
        assert motor.connections > 1, "it is set up again: it may have been switched off and on"


@pytest.mark.parametrize("name", NAMES)
def test_a_stop_comes_before_motion_after_the_host_was_suspended(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """CLOCK_MONOTONIC stops meanwhile, CLOCK_BOOTTIME does not, nor does the controller's watchdog."""
    with connected_motor(name) as (motor, simulated):
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        simulated.expire()
        gettime = time.clock_gettime
        monkeypatch.setattr(
            time, "clock_gettime", lambda clock: gettime(clock) + 3600.0 * (clock == time.CLOCK_BOOTTIME)
        )
        assert motor.send(FORWARD).watchdog_expired and simulated.base.commanded_mps == [0.0, 0.0]
        assert simulated.base.unsafe_resumes == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_reply_is_an_error_and_a_stop_comes_before_motion(name: str) -> None:
    with connected_motor(name, watchdog_ms=SHORT_MS, timeout_s=SHORT_S) as (motor, simulated):
        first_status(motor)
        simulated.drop_replies = True
        assert until(lambda: type(send_error(motor)) is NoReplyError), "LateReplyError at first"
        found = send_error(motor)
        assert "gave no answer" in str(found) and simulated.port in str(found) and "\n" not in str(found)
        simulated.drop_replies = False
        assert first_status(motor).watchdog_expired and simulated.base.commanded_mps == [0.0, 0.0]
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])


@pytest.mark.parametrize("name", NAMES)
def test_a_late_reply_stops_nothing(name: str) -> None:
    with connected_motor(name, timeout_s=SHORT_S) as (motor, simulated):
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        simulated.drop_replies = True
        found, replaced_by_stop = send_error(motor), motor.replaced_by_stop
        assert isinstance(found, LateReplyError) and motor.errors >= 1
        simulated.drop_replies = False
        assert not first_status(motor).watchdog_expired and simulated.base.commanded_mps != [0.0, 0.0]
        assert motor.replaced_by_stop == replaced_by_stop


@pytest.mark.parametrize("name", NAMES)
def test_stops_are_sent_while_no_replies_come(name: str) -> None:
    """As where only the wire of the replies is broken: commands still arrive, and no watchdog expires by them."""
    with connected_motor(name, watchdog_ms=SHORT_MS, timeout_s=SHORT_S) as (motor, simulated):
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        simulated.drop_replies = True
        assert until(lambda: type(send_error(motor)) is NoReplyError)
        for _ in range(3):
            before = simulated.base.commands
            send_error(motor)
            assert until(lambda before=before: simulated.base.commands > before)  # type: ignore[misc]
            assert simulated.base.commanded_mps == [0.0, 0.0]


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_that_was_switched_off_and_on_gets_its_watchdog_and_settings_again(name: str) -> None:
    """As by an emergency stop that takes its power, while the serial adapter stays: the port is never gone."""
    watchdog_ms = SHORT_MS
    with connected_motor(name, watchdog_ms=watchdog_ms, timeout_s=SHORT_S) as (motor, simulated):
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        simulated.drop_input = True
        assert until(lambda: type(send_error(motor)) is NoReplyError)
        simulated.controller = controller_of(name, watchdog_ms=watchdog_ms)  # with the defaults of its firmware
        simulated.drop_input = False
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        assert simulated.base.watchdog_ms == watchdog_ms and motor.connections == 2
        assert simulated.base.unsafe_resumes == 0


def send_error(motor: SerialMotor) -> DriverError:
    """Return the exception raised for a command without a reply."""
    with pytest.raises(DriverError) as caught:
        motor.send(FORWARD)
    return caught.value


@pytest.mark.parametrize("name", NAMES)
def test_the_driver_recovers_from_garbage(name: str) -> None:
    rng = random.Random(21)
    with connected_motor(name, timeout_s=SHORT_S) as (motor, simulated):
        for _ in range(20):
            simulated.garbage = rng.randbytes(rng.randint(1, 40)) + b"\r\n"
            with contextlib.suppress(DriverError):
                motor.send(FORWARD)
        simulated.garbage = b""
        assert until(lambda: first_status(motor) is not None and simulated.base.commanded_mps != [0.0, 0.0])
        assert simulated.base.errors == 0, "received garbage was not sent back"


@pytest.mark.parametrize("name", NAMES)
def test_an_unplugged_controller_is_an_error_and_reconnects(name: str, tmp_path: Path) -> None:
    port = tmp_path / "motor"
    first = PtyMotor(controller_of(name))
    port.symlink_to(first.port)
    motor = SerialMotor(str(port), PROTOCOLS[name](BASE), timeout_s=REPLY_S, watchdog_ms=LONG_MS)
    with contextlib.closing(motor):
        motor.send(FORWARD)
        port.unlink()
        first.close()
        with pytest.raises(DriverError, match="is gone"):
            motor.send(FORWARD)
        with pytest.raises(DriverError, match=r"no such port|tried again"):
            motor.send(FORWARD)
        with contextlib.closing(PtyMotor(controller_of(name))) as second:
            second.expire()  # from now on a first command other than a stop is an error
            port.symlink_to(second.port)
            assert until(lambda: first_status(motor) is not None and second.base.commanded_mps != [0.0, 0.0])
            assert motor.connections == 2 and second.base.errors == 0


def first_status(motor: SerialMotor, tries: int = 200) -> MotorStatus | None:
    """Return the first status received, None without one; a machine under load may be late with it."""
    for _ in range(tries):
        with contextlib.suppress(DriverError):
            return motor.send(FORWARD)
        time.sleep(0.01)
    return None
