"""The safety rules: every reason to stop the wheels, in the order in which it is reported.

Faults of robot, pose and host disarm: with controller.arming = "manual" the wheels stay stopped after them until
cmd/arm. A stop that was asked for latches in every mode. No command, a stale one and a jump of the heading do not
disarm: the operator has let go, or must send again. The whole table, with tests: docs/safety.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from omnid.core.control.motion_monitor import (
    BATTERY_EMPTY,
    CONFLICTS,
    MOTOR_FAULT,
    NOT_COMMANDED,
    NOT_FOLLOWED,
    NOT_SEEN,
    POSE_RESET,
    POSE_UNSURE,
)


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


ENDS: Final = "the run ends"
ASKED: Final = "a stop was asked for"
AWAITED: Final = "waiting for the motor"
FAILED: Final = "the motor controller failed"
STOPPED: Final = "the motor controller had stopped by itself"
CLIFF: Final = "a cliff sensor sees no floor"
BUMPER: Final = "the bumper is pressed"
LATCHING: Final = frozenset({BUMPER, CLIFF})  # as a stop that was asked for: only a request to arm releases them
OVERLOADED: Final = "the host is overloaded"
NO_POSE: Final = "there is no pose yet"
POSE_STALE: Final = "the pose is stale"
POSE_LOST: Final = "the pose is lost"
POSE_JUMPED: Final = "the heading of the pose has jumped"
NOT_ARMED: Final = "not armed"
IDLE: Final = "no command"
COMMAND_STALE: Final = "the command is stale"


# These disarm: with controller.arming = "manual" the wheels stay stopped after them until cmd/arm.
FAULTS: Final = (
    *(CLIFF, BUMPER, AWAITED, FAILED, STOPPED, MOTOR_FAULT, BATTERY_EMPTY),
    *(OVERLOADED, NO_POSE, POSE_STALE, POSE_LOST, POSE_RESET, POSE_UNSURE),
    *(NOT_FOLLOWED, NOT_SEEN, NOT_COMMANDED, *CONFLICTS),
)
# The first rule that holds is reported. The end and a stop are no faults: nothing follows the end, and a stop latches
# in any mode. A heading that jumps is none: odometry has closed a gap, and only setpoints from before are void.
RULES: Final = (ENDS, ASKED, *FAULTS, POSE_JUMPED, NOT_ARMED, IDLE, COMMAND_STALE)


def stop_reason(holding: Collection[str], rules: Iterable[str] = RULES) -> str:
    """Return the first reason of the table among those that hold; empty where the wheels may turn."""
    return next((reason for reason in rules if reason in holding), "")
