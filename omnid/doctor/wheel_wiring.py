"""Test of a base's wiring: each motor turns alone, a person names the wheel that moved, and the settings follow.

The wheels must not touch the ground. Commands go straight to the motor controller, without a daemon.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Final

from drivers.motor import MotorDriver, VelocityCommand, stop_command
from drivers.motors.protocols.motor_protocol import DifferentialDrive
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.motor import MotorSettings, open_motor
from omnid.errors import OmnidError

MOVE_S, REST_S = 1.0, 0.3  # duration of a motion in each direction, and of the rest after it

BEFORE: Final = """The wheels will turn. Raise the robot so that none of them touches the ground, keep hands and hair
away from them, and have the emergency stop at hand. The daemon must not run. Ctrl-C stops the wheels. Type yes to
begin: """


def tested_drive(config: MotorSettings, ask: Callable[[str], str], *, speed_mps: float) -> DifferentialDrive:
    """Turn the wheels, ask what they did, and return the settings of the drive as the wiring is.

    ask: prints a question, returns the answer. speed_mps: of a wheel. The wheels stop at the end. Raises OmnidError for
    wrong arguments, and where the answers do not determine the settings.
    """
    if config.protocol == "line":
        raise OmnidError(
            "motor.protocol is 'line': its controller divides the speed between the wheels itself, so "
            "the wiring is set there; see whether it is right by `omnid drive`"
        )
    if not 0 < speed_mps <= config.drive.max_wheel_mps:
        raise OmnidError(
            f"--speed {speed_mps:g}: expected a speed above 0, up to motor.drive.max_wheel_mps = "
            f"{config.drive.max_wheel_mps:g} m/s"
        )
    if ask(BEFORE).lower() != "yes":
        raise OmnidError("not begun: only `yes` starts the motors")
    # Each motor turns alone, forwards and back.
    drive = replace(config.drive, swapped=False, reverse_left=False, reverse_right=False)
    with ExitStack() as closing:
        motor = open_motor(replace(config, drive=drive), closing)
        first_side, is_first_forwards = _turned_wheel(motor, 1, config, speed_mps, ask)
        second_side, is_second_forwards = _turned_wheel(motor, 2, config, speed_mps, ask)
    if first_side == second_side:
        raise OmnidError(f"both motors turned the {first_side} wheel, which cannot be: begin again")
    forwards = {first_side: is_first_forwards, second_side: is_second_forwards}
    reverse_left, reverse_right = not forwards["left"], not forwards["right"]
    return replace(drive, swapped=first_side == "right", reverse_left=reverse_left, reverse_right=reverse_right)


def _turned_wheel(
    motor: MotorDriver, channel: int, config: MotorSettings, speed_mps: float, ask: Callable[[str], str]
) -> tuple[str, bool]:
    """Turn one motor; return the side of the wheel that moved, and whether a positive command turned it forwards."""
    turned_deg = math.degrees(speed_mps * MOVE_S / config.drive.wheel_radius_m)  # one way, where the gear is right
    yaw_sign = -1.0 if channel == 1 else 1.0  # With this turn, the command of the other wheel is 0.
    question = (
        f"Motor {channel} turned its wheel by {turned_deg:.0f} deg and back, or motor.drive.gear is wrong. Name the "
        "wheel that moved (l left, r right, n none or both, a again): "
    )
    side = None
    while side is None:
        for sign in (1, -1):
            velocity_mps, yaw_rate_radps = sign * speed_mps / 2, sign * yaw_sign * speed_mps / config.drive.track_m
            # After a pause the driver sends a stop in place of the first command.
            _send(motor, stop_command(0), 0.0, config.rate_hz)
            _send(motor, VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps), MOVE_S, config.rate_hz)
            _send(motor, stop_command(0), REST_S, config.rate_hz)
        letter = ask(question)[:1].lower()
        if letter == "n":
            raise OmnidError(
                f"motor {channel} did not move one wheel: check power, cable, emergency stop, motor.protocol and "
                "motor.drive.can_id, try a higher --speed"
            )
        side = {"l": "left", "r": "right"}.get(letter)
    answer = ""
    while answer not in ("y", "n"):
        answer = ask(f"Did the {side} wheel turn forwards first, as for driving forwards (y or n)? ")[:1].lower()
    return side, answer == "y"


def _send(motor: MotorDriver, command: VelocityCommand, seconds: float, rate_hz: float) -> None:
    """Send a command until a time has passed, at least once; DriverError where the controller does not answer.

    An answer that comes late is the fault of a busy computer: the command is sent again.
    """
    end_s = time.monotonic() + seconds
    while True:
        with suppress(LateReplyError):
            motor.send(command)
        time.sleep(max(0.0, min(1 / rate_hz, end_s - time.monotonic())))
        if time.monotonic() >= end_s:
            return
