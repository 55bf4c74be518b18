"""The serial motor: with the line protocol and its simulated controller, over a real pty, and what an error names."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.line_protocol import LineProtocol, encode
from drivers.motors.protocols.motor_protocol import DifferentialDrive, NoReplyError
from drivers.motors.serial_motor import SerialMotor
from tests.contract.simulated_controllers import PtyMotor, SimulatedLine, run, until

ROOT = Path(__file__).parents[3]
MODULES = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "drivers/motors").rglob("*.py")]
HEAVY = {"numpy", "cv2", "mcap", "rosbags", "omnid", "calib"}
PROGRAM = """
import importlib, json, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_all_modules_load_no_heavy_package() -> None:
    assert len(MODULES) >= 8
    command = [sys.executable, "-c", PROGRAM, "drivers.motor", *MODULES]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert HEAVY.isdisjoint(json.loads(done.stdout))


PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit
REPLY_S = 2.0
OTHER_ID = 65534  # user and group without rights


@pytest.fixture
def simulated() -> Iterator[PtyMotor]:
    with contextlib.closing(PtyMotor()) as simulated:
        yield simulated


# The serial motor and the simulated controller over a pty


def opens_as_another_user(port: str) -> bool:
    """True if another program can open the port; without the privileges of root, which ignores the exclusive mode."""
    user: dict[str, Any] = {"user": OTHER_ID, "group": OTHER_ID, "extra_groups": []} if os.geteuid() == 0 else {}
    return subprocess.run(["sh", "-c", 'exec 3<> "$0"', port], capture_output=True, check=False, **user).returncode == 0


class SlowToSetUp(SimulatedLine):
    """A controller that takes longer to set its watchdog than a command may take, as an ODrive by 50 commands/s."""

    def handle(self, frame: bytes) -> bytes:
        if frame.startswith(b"$W"):
            time.sleep(0.1)
        return super().handle(frame)


def test_after_silence_a_controller_has_the_time_to_be_set_up_again() -> None:
    with contextlib.closing(PtyMotor(SlowToSetUp(heading_input=False))) as simulated:
        motor = SerialMotor(simulated.port, timeout_s=0.05, watchdog_ms=200, connect_s=PATIENCE_S)
        with contextlib.closing(motor):
            simulated.drop_replies = True
            assert until(lambda: type(failure(motor)) is NoReplyError)
            simulated.drop_replies = False
            assert until(lambda: failure(motor) is None and simulated.base.commanded_mps != [0.0, 0.0])
            assert motor.connections == 2


def failure(motor: SerialMotor) -> DriverError | None:
    """Return the error of a command, None where it got a reply."""
    try:
        motor.send(VelocityCommand(0, 0.3, 0.0, 0.0))
    except DriverError as error:
        return error
    return None


def test_after_a_command_that_was_refused_a_stop_comes_first(simulated: PtyMotor) -> None:
    with contextlib.closing(SerialMotor(simulated.port, timeout_s=REPLY_S)) as motor:
        assert not motor.send(VelocityCommand(0, 0.3, 0.0, 0.0)).watchdog_expired and motor.replaced_by_stop == 0
        with pytest.raises(DriverError):
            motor.send(VelocityCommand(0, math.nan, 0.0, 0.0))
        assert motor.send(VelocityCommand(0, 0.3, 0.0, 0.0)).watchdog_expired and motor.replaced_by_stop == 1
        assert not motor.send(VelocityCommand(0, 0.3, 0.0, 0.0)).watchdog_expired


@pytest.mark.hazard("H42")
def test_no_other_program_can_open_the_port(simulated: PtyMotor) -> None:
    os.chmod(simulated.port, 0o666)
    assert opens_as_another_user(simulated.port)
    motor = SerialMotor(simulated.port, timeout_s=REPLY_S)
    assert not opens_as_another_user(simulated.port)
    with pytest.raises(DriverError, match="in use by another program"):
        SerialMotor(simulated.port, timeout_s=REPLY_S)
    assert not opens_as_another_user(simulated.port), "the second driver has not ended the first one's exclusive mode"
    motor.close()
    assert opens_as_another_user(simulated.port)


@pytest.mark.parametrize(
    ("port", "what"),
    [("/dev/no-such-motor", "no such port"), ("/dev/null", "serial port"), ("/", "serial port"), ("", "port")],
)
def test_open_failure_gives_advice(port: str, what: str) -> None:
    with pytest.raises(DriverError, match=what) as caught:
        SerialMotor(port)
    assert f"motor port {port!r} " in str(caught.value) and "\n" not in str(caught.value)


class FixedWatchdog(SimulatedLine):
    """A controller that keeps its own watchdog time."""

    def handle(self, frame: bytes) -> bytes:
        """Return the usual reply, but with 1000 ms in force."""
        reply = super().handle(frame)
        return encode("A", 1000) if reply.startswith(b"$A") else reply


def test_the_driver_verifies_the_watchdog_in_force() -> None:
    with (
        contextlib.closing(PtyMotor(FixedWatchdog())) as simulated,
        pytest.raises(DriverError, match="500 ms requested, 1000 ms in force"),
    ):
        SerialMotor(simulated.port, timeout_s=REPLY_S)


# The protocol's host, without a port


def test_heading_continues_after_a_reconnection() -> None:
    """A controller measures from 0 again once its watchdog is set; the heading reported by the protocol continues."""
    protocol, simulated = LineProtocol(DifferentialDrive()), SimulatedLine()
    run(protocol.connect(500), simulated, protocol.framer())
    turn(protocol, simulated, 1.0)
    assert simulated.base.pose[2] == pytest.approx(1.0, abs=0.01)
    run(protocol.connect(500), simulated, protocol.framer())
    status = turn(protocol, simulated, 1.5)
    assert simulated.base.pose[2] == pytest.approx(1.5, abs=0.01)
    assert status.heading_rad == pytest.approx(1.5, abs=0.01)


def turn(protocol: LineProtocol, simulated: SimulatedLine, heading_rad: float) -> MotorStatus:
    for _ in range(100):
        command = VelocityCommand(0, 0.1, heading_rad, 0.0)
        status = run(protocol.drive(command), simulated, protocol.framer())
        simulated.base.advance(0.05)
    return status
