"""Test of a base's wiring: each motor turns alone, a person says which wheel moved, and the settings follow from that.

The wheels must not touch the ground. Commands go straight to the motor controller, without a daemon.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Final, NamedTuple

from drivers.motor import MotorDriver, VelocityCommand, stop_command
from drivers.motors.protocols.motor_protocol import NoReplyError
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.motor import open_motor
from omnid.controller.motor_settings import DriveSettings, MotorSettings
from omnid.errors import OmnidError

MOVE_S: Final = 1.0  # Duration of a motion in each direction.
REST_S: Final = 0.3  # The wheels come to rest in this time.
ANSWER_S: Final = 1.0  # A stop is repeated for this time: a busy computer delays answers by parts of it.
LEAST_COMMANDS: Final = 2  # Commands of a motion: the driver may send a stop in place of the first one.
RIGHT_SCALE: Final = 0.03  # difference of the number of turns that is not corrected
LARGEST_TURNS: Final = 1000.0

Ask = Callable[[str], str]  # prints a question, returns the answer


class Seen(NamedTuple):
    """The wheel that a motor turned, and in which direction a positive command turned it."""

    side: str
    forward: bool


class WiringTest:
    """A test of the wiring; its commands stop the wheels also where it is interrupted."""

    def __init__(
        self,
        config: MotorSettings,
        ask: Ask,
        *,
        speed_mps: float,
        turns: float,
        move_s: float = MOVE_S,
        rest_s: float = REST_S,
    ) -> None:
        """speed_mps: of a wheel, above 0. turns: of each wheel, for the scale; 0: leave that out.

        move_s: time for which a motor turns alone, in each direction. rest_s: after each motion.
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
        if not 0 <= turns <= LARGEST_TURNS:
            raise OmnidError(f"--turns {turns:g}: expected 0 to {LARGEST_TURNS:g}")
        self._config, self._ask = config, ask
        self._speed_mps, self._turns, self._move_s, self._rest_s = speed_mps, turns, move_s, rest_s

    def run(self) -> DriveSettings:
        """Return the settings of the drive as the wiring is. Raise OmnidError where the answers do not determine it."""
        plain = replace(self._config.drive, swapped=False, reverse_left=False, reverse_right=False)
        with ExitStack() as closing:
            motor = open_motor(replace(self._config, drive=plain), closing)
            while True:
                first, second = (self._observe(motor, plain.track_m, channel) for channel in (1, 2))
                if first.side != second.side:
                    break
                self._ask(f"Both motors turned the {first.side} wheel, which cannot be. Press Enter to see it again: ")
        drive = replace(plain, **wiring(first, second))
        if not self._turns:
            return drive
        with ExitStack() as closing:
            motor = open_motor(replace(self._config, drive=drive), closing)
            return self._scaled(motor, drive)

    def _observe(self, motor: MotorDriver, track_m: float, channel: int) -> Seen:
        """Turn one motor forwards and back, and ask what moved."""
        turn = -1.0 if channel == 1 else 1.0  # the command of the other wheel becomes 0
        velocity_mps, yaw_rate_radps = self._speed_mps / 2, turn * self._speed_mps / track_m
        while True:
            for sign in (1, -1):
                self._move(motor, sign * velocity_mps, sign * yaw_rate_radps, self._move_s)
            answer = self._ask(
                f"Motor {channel} turned one way and back. Name the wheel that moved (l left, r right, "
                "b both, n none, a again): "
            )
            match answer[:1].lower():
                case "l" | "r" as letter:
                    side = "left" if letter == "l" else "right"
                    break
                case "n":
                    raise OmnidError(
                        f"motor {channel} did not move: check power, cable, emergency stop and motor.protocol"
                        ", or try a higher --speed"
                    )
                case "b":
                    raise OmnidError(
                        f"motor {channel} moved both wheels: are they coupled, or do both controllers have "
                        "one address (motor.drive.can_id)?"
                    )
        question = f"Did the {side} wheel turn forwards first, as for driving forwards (y or n)? "
        while (answer := self._ask(question)[:1].lower()) not in ("y", "n"):
            pass
        return Seen(side, answer == "y")

    def _scaled(self, motor: MotorDriver, drive: DriveSettings) -> DriveSettings:
        """Turn both wheels by a number of turns, ask for the true number, and correct the gear by their ratio."""
        around_m = math.tau * drive.wheel_radius_m
        self._ask(f"Mark both tyres. The wheels will turn forwards {self._turns:g} times. Press Enter: ")
        moved_s = self._move(motor, self._speed_mps, 0.0, self._turns * around_m / self._speed_mps)
        commanded = moved_s * self._speed_mps / around_m
        while True:
            answer = self._ask(f"{commanded:.2f} turns were commanded. How many were there (Enter if as many)? ")
            with suppress(ValueError):  # no number: ask again
                turns = float(answer.replace(",", ".")) if answer else commanded
                if 0 < turns <= LARGEST_TURNS:
                    is_right = abs(turns / commanded - 1) <= RIGHT_SCALE
                    return drive if is_right else replace(drive, gear=float(f"{drive.gear * commanded / turns:.4g}"))

    def _move(self, motor: MotorDriver, velocity_mps: float, yaw_rate_radps: float, duration_s: float) -> float:
        """Drive for this time, then stop; return the time for which it drove, s."""
        period_s = 1 / self._config.rate_hz
        _stop(motor)  # after a pause the driver sends one in place of the first command
        begin_s = next_s = time.monotonic()
        sent = 0
        # A busy computer may have paused this program already: the wheels move nevertheless, if only for a moment.
        while sent < LEAST_COMMANDS or time.monotonic() < begin_s + duration_s:
            sent += 1
            # Without an answer the wheels keep turning, because the controller's watchdog expires much later.
            with suppress(LateReplyError):
                motor.send(VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps))
            next_s += period_s
            time.sleep(max(0.0, min(next_s, begin_s + duration_s) - time.monotonic()))
        moved_s = time.monotonic() - begin_s  # the answer to the stop may come late, the stop does not
        _stop(motor)
        time.sleep(self._rest_s)
        return moved_s


def _stop(motor: MotorDriver) -> None:
    """Stop the wheels; DriverError where the controller gives no answer within ANSWER_S.

    A late one is the fault of a busy computer: the stop is sent again.
    """
    deadline_s = time.monotonic() + ANSWER_S
    while True:
        try:
            motor.send(stop_command(0))
            return
        except NoReplyError:
            if time.monotonic() >= deadline_s:
                raise


def wiring(first: Seen, second: Seen) -> dict[str, bool]:
    """Return the settings of a base by the wheels that its two motors turn, which must be different wheels."""
    left, right = (first, second) if first.side == "left" else (second, first)
    return {"swapped": first.side == "right", "reverse_left": not left.forward, "reverse_right": not right.forward}
