"""An error names what was measured: what a port sends in place of an answer, in all protocols, over a real pty."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand, stop_command
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import crc16
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_base import SimulatedBase
from tests.contract.pty_motor import PtyMotor
from tests.contract.simulated_controllers import SimulatedController, SimulatedODrive, SimulatedRoboteq, SimulatedVesc

DRIVE = DifferentialDrive(can_id=2)
NAMES = sorted(PROTOCOLS)


class Board:
    """A board that answers as a function says."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self.base, self.feed = SimulatedBase(DRIVE), answer


def other_baud(data: bytes) -> bytes:
    """Return bytes as a line of another speed makes them."""
    return bytes(random.Random(len(data)).choice((0x00, 0x80, 0xE0, 0xF8, 0xFE, 0x1C)) for _ in range(24))


def line(body: str) -> bytes:
    return b"$%b*%04X\n" % (body.encode(), crc16(body.encode()))


def without_checksums(data: bytes) -> bytes:
    """An ODrive that sends none."""
    return b"".join(answer.partition(b"*")[0] + b"\n" for answer in SimulatedODrive(DRIVE).feed(data).splitlines())


def one_axis(data: bytes) -> bytes:
    """An ODrive that answers nothing about its second axis."""
    return SimulatedODrive(DRIVE).feed(b"".join(each for each in data.splitlines(True) if b"axis1" not in each))


def text_of_another_firmware(_: bytes) -> bytes:
    return b"Marlin 2.1 ready\r\nok\r\n"


EVERY = [
    *((name, lambda _: b"", "not a byte") for name in NAMES),
    *((name, lambda data: data, "what comes back is what was sent; are TX and RX joined") for name in NAMES),
    *((name, other_baud, "no text; check the baud rate (115200, motor.baud)") for name in NAMES),
    *((name, text_of_another_firmware, "Marlin 2.1 ready") for name in NAMES),
]


@pytest.mark.parametrize(
    ("name", "answer", "expected"),
    [
        *EVERY,
        (
            "vesc",
            SimulatedVesc(replace(DRIVE, can_id=3)).feed,
            "VESC 77 answers, none with id 2 on CAN: motor.drive.can_id",
        ),
        ("vesc", SimulatedVesc(replace(DRIVE, can_id=77)).feed, "VESC 77 answers, none with id 2 on CAN"),
        ("odrive_ascii", without_checksums, "carry no checksum"),
        ("odrive_ascii", one_axis, "3 of 6 answers came, none to 'r axis1.config.enable_watchdog'"),
        ("roboteq", lambda _: b"+\r+\rRWD=500\r", "confirmed 2 of 2 commands, and says nothing of MXMD"),
        ("line", lambda _: b"$A,500*0000\n", "wrong checksum"),
        ("line", lambda _: line("S,0,1,2,3"), "line S has 4 numbers, not 8; check the firmware"),
        ("line", lambda _: b"$GPGGA,1,2*77\n", "is not a line of the motor protocol"),
    ],
)
def test_what_is_measured_is_named(name: str, answer: Callable[[bytes], bytes], expected: str) -> None:
    with contextlib.closing(PtyMotor(Board(answer))) as board, pytest.raises(DriverError) as caught:
        SerialMotor(board.port, PROTOCOLS[name](DRIVE), timeout_s=0.3, connect_s=0.1)
    assert expected in str(caught.value) and board.port in str(caught.value) and "\n" not in str(caught.value)


class Idle(SimulatedODrive):
    """Its axes are not calibrated: they take no closed-loop control, and have no error."""

    def _arm(self, axis: int, name: str, value: float) -> bytes:
        return super()._arm(axis, name, value) if name == "error" else b""


class OneChannel(SimulatedRoboteq):
    """It has one motor."""

    def handle(self, frame: bytes) -> bytes:
        """Return the speed of one channel."""
        return super().handle(frame).replace(b"S=0:0", b"S=0")


@pytest.mark.parametrize(
    ("name", "controller", "expected"),
    [
        ("odrive_ascii", Idle(DRIVE), "axis 0 does not turn: it is in state 1 (idle), not in closed-loop control (8)"),
        ("roboteq", OneChannel(DRIVE), "it has one channel; a base needs two"),
    ],
)
def test_a_board_that_cannot_drive_says_why(name: str, controller: SimulatedController, expected: str) -> None:
    problems = set()
    with contextlib.closing(PtyMotor(controller)) as board:
        motor = SerialMotor(board.port, PROTOCOLS[name](DRIVE), timeout_s=1.0, watchdog_ms=10_000, connect_s=0.0)
        with contextlib.closing(motor):
            for command in [stop_command(0), *[VelocityCommand(0, 0.3, 0.0, 0.0)] * 40]:
                try:
                    motor.send(command)
                except DriverError as error:
                    problems.add(str(error).partition(": ")[2])
    assert any(problem.startswith(expected) for problem in problems), problems
