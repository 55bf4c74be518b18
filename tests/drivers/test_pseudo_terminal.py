"""A pseudo-terminal whose number is used again by another program is not taken for the port that it was."""

from __future__ import annotations

import contextlib
import os
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from drivers.pseudo_terminal import TerminalCheck

TRIES = 200
KERNEL_TICK_S = 0.05  # times of files are not finer than a tick
PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit


@contextlib.contextmanager
def foreign_terminal(path: str) -> Iterator[tuple[int, int]]:
    """Yield both ends of a new pseudo-terminal of a given path, which is free: the lowest free numbers are given."""
    with contextlib.ExitStack() as ends:
        for _ in range(TRIES):
            host, device = os.openpty()
            for end in (host, device):
                ends.callback(os.close, end)
            if os.ttyname(device) == path:
                os.set_blocking(host, False)
                yield host, device
                return
        raise AssertionError(f"{path} was not given again")


def refusal(motor: SerialMotor, command: VelocityCommand) -> str:
    """Return why the port is not opened again, when it is tried."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        with pytest.raises(DriverError) as raised:
            motor.send(command)
        if "tried again" not in str(raised.value):
            return str(raised.value)
        time.sleep(0.02)
    raise AssertionError("it was not tried again")


@pytest.mark.hazard("H43")
@pytest.mark.parametrize("linked", [True, False])
def test_a_motor_does_not_talk_to_the_terminal_of_another_program(linked: bool, tmp_path: Path) -> None:
    simulated, link = SimulatedMotor(), tmp_path / "motor"
    link.symlink_to(simulated.port)
    path = simulated.port
    command = VelocityCommand(0, 0.2, 0.0, 0.0)
    with contextlib.closing(SerialMotor(str(link) if linked else path, timeout_s=PATIENCE_S)) as motor:
        motor.send(command)
        time.sleep(KERNEL_TICK_S)
        simulated.close()
        with pytest.raises(DriverError, match="is gone"):
            motor.send(command)
        with foreign_terminal(path) as (host, device):
            before = termios.tcgetattr(device)
            assert f"{path} belongs to another program" in refusal(motor, command)
            with pytest.raises(BlockingIOError):
                os.read(host, 100)
            assert termios.tcgetattr(device) == before


def test_a_link_that_is_made_again_leads_to_the_new_terminal(tmp_path: Path) -> None:
    link = tmp_path / "port"
    check = TerminalCheck(str(link))
    check.require_same()  # nothing is there yet: the opening tells it
    with contextlib.closing(SimulatedMotor()) as first:
        link.symlink_to(first.port)
        check.require_same()
        check.require_same()
        link.unlink()
    with contextlib.closing(SimulatedMotor()) as second:
        link.symlink_to(second.port)
        check.require_same()


def test_other_files_pass(tmp_path: Path) -> None:
    for name in (str(tmp_path / "file"), "/dev/null", "/dev/\0"):
        check = TerminalCheck(name)
        check.require_same()
        (tmp_path / "file").touch()
        check.require_same()
        (tmp_path / "file").unlink()
