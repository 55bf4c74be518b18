"""The safety rules: every reason to stop the wheels, in the order in which it is reported.

Faults of robot, pose and host disarm: with controller.arming = "manual" the wheels stay stopped after them until
cmd/arm. A stop that was asked for latches in every mode. No command, a stale one and a jump of the heading do not
disarm: the operator has let go, or must send again. The whole table, with tests: docs/safety.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from msgspec import Meta

from omnid.core.control.contacts import BUMPER, CLIFF
from omnid.core.control.motion_monitor import CONFLICTS, NOT_COMMANDED, NOT_FOLLOWED, NOT_SEEN
from omnid.tracking_state import TrackingState


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Ages of pose and setpoint, and lateness of a tick, beyond which the wheels stop."""

    pose_s: Annotated[float, Meta(ge=0.05, le=10), "the wheels stop when the newest pose's images are older, s"] = 0.5
    command_s: Annotated[
        float, Meta(ge=0.05, le=10), "the wheels stop when the newest setpoint arrived longer ago, s"
    ] = 0.5
    tick_s: Annotated[
        float, Meta(ge=0.01, le=10), "the wheels stop when a tick is later, because the host is overloaded, s"
    ] = 0.25


@dataclass(frozen=True, slots=True)
class SafetyInputs:
    """Inputs of the rules at one tick; the age of a pose or setpoint that never came is inf."""

    pose_age_s: float
    pose_state: str  # tracking | degraded | lost
    command_age_s: float  # age of a setpoint that arrived after the last stop
    late_s: float = 0.0
    pose_jumped: bool = False  # the heading differs from the one before by more than the base can turn
    motor_awaited: bool = False  # True until the motor controller has answered for the first time
    motor_failed: bool = False  # True if the motor controller failed at the last tick
    pose_reset: bool = False  # odometry has lost its map and begun again
    pose_unsure: bool = False  # the velocity has been too uncertain for too long
    motor_stopped: bool = False  # True if the motor controller stopped by itself before the last tick
    motor_faulty: bool = False  # True if the motor controller reports a fault
    battery_empty: bool = False
    contact: str = ""  # BUMPER or CLIFF
    disagreement: str = ""  # disagreement between commanded, reported and seen motion
    stop_asked: bool = False  # True if a stop was requested and cmd/arm has not released it
    armed: bool = True
    ending: bool = False


class Rule(NamedTuple):
    """One reason to stop the wheels."""

    reason: str  # a few words
    disarms: bool  # a fault: with controller.arming = "manual" the wheels stay stopped after it until cmd/arm
    holds: Callable[[SafetyInputs, Deadlines], bool]


ENDS: Final = "the run ends"
ASKED: Final = "a stop was asked for"
AWAITED: Final = "waiting for the motor"
FAILED: Final = "the motor controller failed"
STOPPED: Final = "the motor controller had stopped by itself"
OVERLOADED: Final = "the host is overloaded"
NO_POSE: Final = "there is no pose yet"
POSE_STALE: Final = "the pose is stale"
POSE_LOST: Final = "the pose is lost"
POSE_JUMPED: Final = "the heading of the pose has jumped"
POSE_RESET: Final = "odometry has lost its map and begun again"
POSE_UNSURE: Final = "the pose is too uncertain"
MOTOR_FAULT: Final = "the motor controller reports a fault"
BATTERY_EMPTY: Final = "the battery is empty"
NOT_ARMED: Final = "not armed"
IDLE: Final = "no command"
COMMAND_STALE: Final = "the command is stale"


def _disagree(reason: str) -> Rule:
    return Rule(reason, True, lambda now, _: now.disagreement == reason)


# The first rule that holds is reported. A NaN is a reason. A pose from the future by more than the deadline is one too.
# The end and a stop are no faults: nothing follows the end, and a stop latches in any mode. A heading that jumps is no
# reason: odometry has closed a gap, and only setpoints from before the jump are void.
RULES: Final = (
    Rule(ENDS, False, lambda now, _: now.ending),
    Rule(ASKED, False, lambda now, _: now.stop_asked),
    Rule(CLIFF, True, lambda now, _: now.contact == CLIFF),
    Rule(BUMPER, True, lambda now, _: now.contact == BUMPER),
    Rule(AWAITED, True, lambda now, _: now.motor_awaited),
    Rule(FAILED, True, lambda now, _: now.motor_failed),
    Rule(STOPPED, True, lambda now, _: now.motor_stopped),
    Rule(MOTOR_FAULT, True, lambda now, _: now.motor_faulty),
    Rule(BATTERY_EMPTY, True, lambda now, _: now.battery_empty),
    Rule(OVERLOADED, True, lambda now, deadlines: not now.late_s <= deadlines.tick_s),
    Rule(NO_POSE, True, lambda now, _: now.pose_age_s == float("inf")),
    Rule(POSE_STALE, True, lambda now, deadlines: not abs(now.pose_age_s) <= deadlines.pose_s),
    Rule(POSE_LOST, True, lambda now, _: now.pose_state == TrackingState.LOST),
    Rule(POSE_RESET, True, lambda now, _: now.pose_reset),
    Rule(POSE_UNSURE, True, lambda now, _: now.pose_unsure),
    *map(_disagree, (NOT_FOLLOWED, NOT_SEEN, NOT_COMMANDED, *CONFLICTS)),
    Rule(POSE_JUMPED, False, lambda now, _: now.pose_jumped),
    Rule(NOT_ARMED, False, lambda now, _: not now.armed),
    Rule(IDLE, False, lambda now, _: now.command_age_s == float("inf")),
    Rule(COMMAND_STALE, False, lambda now, deadlines: not abs(now.command_age_s) <= deadlines.command_s),
)
FAULTS: Final = tuple(rule for rule in RULES if rule.disarms)


def stop_reason(now: SafetyInputs, deadlines: Deadlines, rules: Iterable[Rule] = RULES) -> str:
    """Return the reason of the first rule that holds; empty where the wheels may turn."""
    return next((rule.reason for rule in rules if rule.holds(now, deadlines)), "")
