"""What every motor protocol owes the driver, against its twin and without a port: units, signs, limits, any bytes."""

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
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import Framer, MotorProtocol
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.simulated.controller_registry import SIMULATED_CONTROLLERS
from drivers.motors.simulated.simulated_motor import SimulatedController
from tests.contract.simulated_motors import BASE, LONG_MS, NAMES, answer, controller_of

WIRINGS = [
    BASE,
    replace(BASE, reverse_right=True),
    replace(BASE, reverse_left=True, swapped=True),
    replace(BASE, swapped=True, can_id=200),
]


class Talk:
    """A protocol connected to its twin; a tick is 50 ms."""

    def __init__(self, name: str, drive: DifferentialDrive = BASE) -> None:
        self.protocol: MotorProtocol = PROTOCOLS[name](drive)
        self.controller: SimulatedController = controller_of(name, drive)
        self.base = self.controller.base
        self.framer: Framer = self.protocol.framer()
        self.now_s = 0.0
        answer(self.protocol.connect(LONG_MS), self.controller, self.framer)
        self.tell(stop_command(0))

    def tell(self, command: VelocityCommand) -> MotorStatus:
        return answer(self.protocol.drive(command, self.now_s), self.controller, self.framer)

    def drive(self, seconds: float, velocity_mps: float, yaw_rate_radps: float) -> MotorStatus:
        for _ in range(round(seconds / 0.05)):
            status = self.tell(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
            self.base.advance(0.05)
            self.now_s += 0.05
        return status


def test_every_protocol_has_a_twin() -> None:
    assert set(PROTOCOLS) == set(SIMULATED_CONTROLLERS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drive", WIRINGS)
def test_the_way_is_the_one_that_was_told(name: str, drive: DifferentialDrive) -> None:
    talk = Talk(name, drive)
    talk.drive(2.0, 0.5, 0.0)
    x_m, y_m, heading_rad = talk.base.pose
    assert x_m == pytest.approx(1.0 - 0.5 * 0.5 * 0.5 / 2.0, rel=0.01)  # less what the start took at 2 m/s^2
    assert (y_m, heading_rad) == pytest.approx((0.0, 0.0), abs=1e-6)
    talk.drive(0.5, 0.0, 0.0)
    heading_rad = talk.base.pose[2]
    talk.drive(1.0, 0.0, -1.0)
    talk.drive(0.5, 0.0, 0.0)
    assert talk.base.pose[2] - heading_rad == pytest.approx(-1.0, rel=0.01)
    assert talk.base.errors == 0 and talk.protocol.bad_frames == 0 and talk.framer.garbage == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drive", WIRINGS)
def test_an_arc_has_its_radius_and_its_status(name: str, drive: DifferentialDrive) -> None:
    talk = Talk(name, drive)
    talk.drive(1.0, 0.4, 0.5)
    before = talk.base.pose
    status = talk.drive(2.0, 0.4, 0.5)
    chord_m = math.dist(before[:2], talk.base.pose[:2])
    assert chord_m == pytest.approx(2 * 0.8 * math.sin(0.5), rel=0.01)  # a turn of 1 rad at a radius of 0.8 m
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.4, 0.5), rel=0.02)
    assert not status.watchdog_expired and status.fault == 0
    assert status.battery_v == 12.0 or name == "ros_arduino_bridge"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("velocity_mps", "yaw_rate_radps"), [(8.0, 4.0), (-3.0, 2.0), (0.9, -4.0), (0.0, 50.0)])
def test_wheels_that_would_be_too_fast_keep_the_curvature(
    name: str, velocity_mps: float, yaw_rate_radps: float
) -> None:
    talk = Talk(name)
    talk.tell(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
    told = talk.base.last_command
    assert max(map(abs, talk.base.commanded_mps)) == pytest.approx(BASE.max_wheel_mps, rel=0.01)
    assert told.velocity_mps * yaw_rate_radps == pytest.approx(told.yaw_rate_radps * velocity_mps, abs=0.05)
    assert talk.base.errors == 0


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("waveshare_json", "ros_arduino_bridge")])
def test_a_fault_and_a_low_battery_are_told(name: str) -> None:
    talk = Talk(name)
    talk.base.fault, talk.base.battery_v = 16, 9.5
    status = talk.tell(stop_command(0))
    assert (status.fault, status.battery_v) == (16, 9.5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["velocity_mps", "yaw_rate_radps", "heading_rad"])
def test_what_is_not_finite_never_becomes_bytes(name: str, bad: float, field: str) -> None:
    command = replace(VelocityCommand(0, 0.1, 0.1, 0.1), **{field: bad})
    with pytest.raises(DriverError, match="only finite"):
        next(PROTOCOLS[name](BASE).drive(command, 0.0))


@pytest.mark.parametrize("name", NAMES)
def test_any_bytes_to_the_host(name: str) -> None:
    """Neither a frame nor a stream of anything ends in more than a DriverError."""
    rng, protocol = random.Random(11), PROTOCOLS[name](BASE)
    for noise in noises(rng, answers_of(name)):
        for script in (protocol.connect(LONG_MS), protocol.drive(stop_command(0), rng.random())):
            framer = protocol.framer()
            next(script)
            with contextlib.suppress(DriverError, StopIteration):
                for frame in framer.feed(noise):
                    script.send(frame)


@pytest.mark.parametrize("name", NAMES)
def test_any_bytes_to_the_twin(name: str) -> None:
    rng, talk = random.Random(12), Talk(name)
    talk.base.advance(0.1)
    orders = next(talk.protocol.drive(VelocityCommand(0, 0.3, 0.2, 0.1), 1.0))
    for noise in noises(rng, orders):
        assert isinstance(talk.controller.feed(noise), bytes)
    assert talk.base.errors > 100
    assert all(map(math.isfinite, talk.base.commanded_mps))


@pytest.mark.parametrize("name", NAMES)
def test_endless_noise_needs_no_memory(name: str) -> None:
    rng, framer = random.Random(13), PROTOCOLS[name](BASE).framer()
    streams = [rng.randbytes(4096).replace(b"\n", b"x").replace(b"\r", b"x"), b"\x03\x01\xff" * 1000, b"$" * 4096]
    tracemalloc.start()
    for _ in range(5):
        for stream in streams:
            framer.feed(stream)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 50_000 and framer.garbage > 0


@pytest.mark.parametrize("name", NAMES)
def test_frames_come_whole_out_of_any_pieces(name: str) -> None:
    rng, said = random.Random(14), answers_of(name)
    whole = PROTOCOLS[name](BASE).framer().feed(said)
    for _ in range(50):
        framer, found, rest = PROTOCOLS[name](BASE).framer(), [], said
        while rest:
            size = rng.randint(1, 9)
            found += framer.feed(rest[:size])
            rest = rest[size:]
        assert found == whole and framer.garbage == 0


def answers_of(name: str) -> bytes:
    """What the twin says to a command."""
    talk = Talk(name)
    return talk.controller.feed(next(talk.protocol.drive(stop_command(0), 1.0)))


def noises(rng: random.Random, valid: bytes) -> Iterator[bytes]:
    """Bytes without sense, and valid ones with a bit, a piece or their order changed."""
    for _ in range(150):
        yield rng.randbytes(rng.randint(0, 60)) + b"\r\n"
    for _ in range(150):
        damaged = bytearray(valid)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        yield bytes(damaged)
        start, end = sorted(rng.sample(range(len(valid)), 2))
        yield valid[start:end] + valid[:start] + b"\n"
