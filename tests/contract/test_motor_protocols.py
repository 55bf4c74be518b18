"""Requirements on every motor protocol, tested with its simulated controller: units, signs, limits, invalid bytes."""

from __future__ import annotations

import contextlib
import math
import random
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import Framer, MotorProtocol
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from tests.contract.pty_motor import BASE, LONG_MS, NAMES, controller_of, run
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, SimulatedController

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
        self.now_s = 0.0
        run(self.protocol.connect(LONG_MS), self.controller, self.framer)
        self.send(stop_command(0))

    def send(self, command: VelocityCommand) -> MotorStatus:
        return run(self.protocol.drive(command, self.now_s), self.controller, self.framer)

    def drive(self, seconds: float, velocity_mps: float, yaw_rate_radps: float) -> MotorStatus:
        for _ in range(round(seconds / 0.05)):
            status = self.send(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
            self.base.advance(0.05)
            self.now_s += 0.05
        return status


def test_every_protocol_has_a_simulated_controller() -> None:
    assert set(PROTOCOLS) == set(SIMULATED_CONTROLLERS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drive", WIRINGS)
def test_drives_the_commanded_distance_and_angle(name: str, drive: DifferentialDrive) -> None:
    connection = Connection(name, drive)
    connection.drive(2.0, 0.5, 0.0)
    x_m, y_m, heading_rad = connection.base.pose
    assert x_m == pytest.approx(1.0 - 0.5 * 0.5 * 0.5 / 2.0, rel=0.01)  # less the loss by accelerating at 2 m/s^2
    assert (y_m, heading_rad) == pytest.approx((0.0, 0.0), abs=1e-6)
    connection.drive(0.5, 0.0, 0.0)
    heading_rad = connection.base.pose[2]
    connection.drive(1.0, 0.0, -1.0)
    connection.drive(0.5, 0.0, 0.0)
    assert connection.base.pose[2] - heading_rad == pytest.approx(-1.0, rel=0.01)
    assert connection.base.errors == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drive", WIRINGS)
def test_drives_the_commanded_arc_and_reports_it(name: str, drive: DifferentialDrive) -> None:
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
def test_refuses_numbers_that_are_not_finite(name: str, bad: float, field: str) -> None:
    command = replace(VelocityCommand(0, 0.1, 0.1, 0.1), **{field: bad})
    with pytest.raises(DriverError, match="only finite"):
        next(PROTOCOLS[name](BASE).drive(command, 0.0))


@pytest.mark.parametrize("name", NAMES)
def test_host_accepts_any_bytes(name: str) -> None:
    """No bytes raise anything but DriverError."""
    rng, protocol = random.Random(11), PROTOCOLS[name](BASE)
    for noise in noises(rng, replies_of(name)):
        for transaction in (protocol.connect(LONG_MS), protocol.drive(stop_command(0), rng.random())):
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


@pytest.mark.parametrize("name", NAMES)
def test_framer_accepts_pieces_of_any_size(name: str) -> None:
    rng, replies = random.Random(14), replies_of(name)
    whole = PROTOCOLS[name](BASE).framer().feed(replies)
    for _ in range(50):
        framer, found, rest = PROTOCOLS[name](BASE).framer(), [], replies
        while rest:
            size = rng.randint(1, 9)
            found += framer.feed(rest[:size])
            rest = rest[size:]
        assert found == whole


def replies_of(name: str) -> bytes:
    """Return the replies of the simulated controller to a stop."""
    connection = Connection(name)
    return connection.controller.feed(next(connection.protocol.drive(stop_command(0), 1.0)))


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
