"""The safety rules: every reason to stop the wheels, in the order in which it is reported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from omnid.settings import knob
from omnid.tracking_state import TrackingState


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Ages of pose and setpoint, and lateness of a tick, beyond which the wheels stop."""

    pose_s: float = knob(0.5, "the wheels stop when the newest pose's images are older, s", low=0.05, high=10)
    command_s: float = knob(0.5, "the wheels stop when the newest setpoint arrived longer ago, s", low=0.05, high=10)
    tick_s: float = knob(0.25, "the wheels stop when a tick is later, because the host is overloaded, s", low=0.01,
                         high=10)


@dataclass(frozen=True, slots=True)
class SafetyInputs:
    """Inputs of the rules at one tick; the age of a pose or setpoint that never came is inf."""

    pose_age_s: float
    pose_state: str  # tracking | degraded | lost
    command_age_s: float  # of a setpoint that arrived after the last stop
    late_s: float = 0.0
    motor_failed: bool = False  # at the last tick
    motor_stopped: bool = False  # by the motor controller itself, before the last tick
    stop_asked: bool = False
    ending: bool = False


ENDS: Final = "the run ends"
ASKED: Final = "a stop was asked for"
FAILED: Final = "the motor controller failed"
STOPPED: Final = "the motor controller had stopped by itself"
OVERLOADED: Final = "the host is overloaded"
POSE_STALE: Final = "the pose is stale"
POSE_LOST: Final = "the pose is lost"
IDLE: Final = "no command"
COMMAND_STALE: Final = "the command is stale"


def stop_reason(now: SafetyInputs, deadlines: Deadlines) -> str:
    """Return the reason why the wheels must stop, in a few words; empty where they may turn.

    A NaN is a reason, and so is an age as far below 0 as it may be above: no pose comes from the future.
    """
    reasons = (
        (now.ending, ENDS),
        (now.stop_asked, ASKED),
        (now.motor_failed, FAILED),
        (now.motor_stopped, STOPPED),
        (not now.late_s <= deadlines.tick_s, OVERLOADED),
        (not abs(now.pose_age_s) <= deadlines.pose_s, POSE_STALE),
        (now.pose_state == TrackingState.LOST, POSE_LOST),
        (now.command_age_s == float("inf"), IDLE),
        (not abs(now.command_age_s) <= deadlines.command_s, COMMAND_STALE),
    )
    return next((reason for holds, reason in reasons if holds), "")
