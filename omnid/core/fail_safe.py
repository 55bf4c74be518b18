"""Whether the wheels may turn: every reason to stop, in the order in which it is told."""

from __future__ import annotations

from dataclasses import dataclass

from omnid.core.ego_motion import LOST


@dataclass(frozen=True, slots=True)
class Deadlines:
    """What is too old or too late to drive by, s."""

    pose_s: float = 0.5  # since the capture of the newest pose's pictures
    command_s: float = 0.5  # since the arrival of the newest command
    tick_s: float = 0.25  # by which a tick comes later than it should: the host is overloaded


@dataclass(frozen=True, slots=True)
class Situation:
    """What one tick of the wheels knows; inf is the age of what never came."""

    pose_age_s: float
    pose_state: str  # tracking | degraded | lost
    command_age_s: float  # of a command that came after the last stop
    late_s: float = 0.0
    motor_failed: bool = False  # at the last tick
    stop_asked: bool = False
    ending: bool = False


IDLE = "no command"


def reason_to_stop(now: Situation, deadlines: Deadlines) -> str:
    """Why the wheels must stand, in a few words; empty where they may turn. A number that is NaN is a reason."""
    reasons = (
        (now.ending, "the daemon ends"),
        (now.stop_asked, "a stop was asked for"),
        (now.motor_failed, "the motor controller failed"),
        (not now.late_s <= deadlines.tick_s, "the host is overloaded"),
        (not now.pose_age_s <= deadlines.pose_s, "the pose is stale"),
        (now.pose_state == LOST, "the pose is lost"),
        (now.command_age_s == float("inf"), IDLE),
        (not now.command_age_s <= deadlines.command_s, "the command is stale"),
    )
    return next((reason for holds, reason in reasons if holds), "")
