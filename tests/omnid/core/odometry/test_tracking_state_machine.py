"""The tracking state: a table of transitions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.tracking_state_machine import TrackingStatus
from omnid.tracking_state import TrackingState

DT_S = 0.125
# Lost from the third refused frame on, and started again at the second unmatched one.
LIMITS = OdometryLimits(good_inliers=50, lost_s=0.2, restart_s=0.1, max_gap_s=0.5)

TRACKING, DEGRADED, LOST = TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST
STARTED, NOT_STARTED, ACCEPTED, REFUSED = "started", "without_map", "accepted", "refused"

FIRST = TrackingStatus()
FIX = TrackingStatus(TRACKING, has_begun=True)
ROUGH = replace(FIX, state=DEGRADED)


def refused(state: TrackingState, frames: int, unmatched: int = 0, **facts: Any) -> TrackingStatus:
    """Return the status after frames that were refused, over which nothing measured the motion where facts say so."""
    unmatched_s = (unmatched - 1) * DT_S if unmatched else None
    status = TrackingStatus(state, (frames - 1) * DT_S, unmatched_s, frames * DT_S, has_begun=True, unknown_motion=True)
    return replace(status, **facts)


REFUSED_ONCE, REFUSED_TWICE = refused(DEGRADED, 1), refused(DEGRADED, 2)
DARK, UNMATCHED = refused(LOST, 3), refused(LOST, 4, 1)
BEGINS_AGAIN = refused(LOST, 5, 2, restart=True)
CARRIED = refused(DEGRADED, 4, 1, unknown_motion=False)
CARRIED_AND_BEGINS_AGAIN = refused(DEGRADED, 5, 2, restart=True, unknown_motion=False)
WITHOUT_MAP = replace(FIX, state=LOST, time_since_fix_s=5 * DT_S, unknown_motion=True)
CARRIED_WITHOUT_MAP = replace(WITHOUT_MAP, state=DEGRADED, unknown_motion=False)
ONE_RESET = replace(FIX, resets=1)

TRANSITIONS = [
    # before, frame, after
    (FIRST, (STARTED, dict()), FIX),
    (FIRST, (NOT_STARTED, dict(dt_s=DT_S)), TrackingStatus(LOST, time_since_fix_s=DT_S)),
    (
        TrackingStatus(LOST, time_since_fix_s=DT_S),
        (NOT_STARTED, dict(dt_s=DT_S)),
        TrackingStatus(LOST, time_since_fix_s=2 * DT_S),
    ),
    (TrackingStatus(LOST, time_since_fix_s=DT_S), (STARTED, dict()), FIX),
    (FIX, (ACCEPTED, dict(dt_s=DT_S)), FIX),
    (FIX, (ACCEPTED, dict(dt_s=DT_S, doubtful=True)), ROUGH),
    (ROUGH, (ACCEPTED, dict(dt_s=DT_S)), FIX),
    (FIX, (ACCEPTED, dict(dt_s=DT_S, doubtful=True)), ROUGH),
    (FIX, (ACCEPTED, dict(dt_s=0.5)), FIX),
    (FIX, (ACCEPTED, dict(dt_s=0.75)), ROUGH),
    (FIX, (REFUSED, dict(dt_s=DT_S)), REFUSED_ONCE),
    (REFUSED_ONCE, (ACCEPTED, dict(dt_s=DT_S)), ROUGH),
    (REFUSED_ONCE, (ACCEPTED, dict(dt_s=DT_S, turned=True)), replace(ROUGH, resets=1)),
    (REFUSED_ONCE, (REFUSED, dict(dt_s=DT_S)), REFUSED_TWICE),
    (REFUSED_TWICE, (REFUSED, dict(dt_s=DT_S, textured=False)), DARK),
    (DARK, (REFUSED, dict(dt_s=DT_S, textured=False)), refused(LOST, 4)),
    (DARK, (REFUSED, dict(dt_s=DT_S)), UNMATCHED),
    (UNMATCHED, (REFUSED, dict(dt_s=DT_S, textured=False)), refused(LOST, 5, 1)),
    (UNMATCHED, (REFUSED, dict(dt_s=DT_S)), BEGINS_AGAIN),
    (REFUSED_ONCE, (REFUSED, dict(dt_s=DT_S, elsewhere=True)), REFUSED_TWICE),
    (DARK, (REFUSED, dict(dt_s=DT_S, elsewhere=True)), replace(UNMATCHED, restart=True)),
    (UNMATCHED, (ACCEPTED, dict(dt_s=DT_S)), ROUGH),
    # Wheels and gyro carry the pose on; the motion is known only where they do so from the last fix on.
    (FIX, (REFUSED, dict(dt_s=DT_S, carried=True)), refused(DEGRADED, 1, unknown_motion=False)),
    (REFUSED_TWICE, (REFUSED, dict(dt_s=DT_S, textured=False, carried=True)), replace(DARK, state=DEGRADED)),
    (CARRIED, (REFUSED, dict(dt_s=DT_S, carried=True)), CARRIED_AND_BEGINS_AGAIN),
    (UNMATCHED, (REFUSED, dict(dt_s=DT_S, carried=True)), replace(BEGINS_AGAIN, state=DEGRADED)),
    # They say that it has hardly moved, and the images that the map is not in view.
    (CARRIED, (REFUSED, dict(dt_s=DT_S, carried=True, stayed=True)), replace(BEGINS_AGAIN, state=DEGRADED)),
    (
        CARRIED,
        (REFUSED, dict(dt_s=DT_S, textured=False, carried=True, stayed=True)),
        refused(DEGRADED, 5, 1, unknown_motion=False),
    ),
    # The map is started again.
    (BEGINS_AGAIN, (STARTED, dict()), replace(ROUGH, resets=1)),
    (BEGINS_AGAIN, (STARTED, dict(elsewhere=True)), ONE_RESET),
    (replace(BEGINS_AGAIN, resets=3), (STARTED, dict()), replace(ROUGH, resets=4)),
    (CARRIED_AND_BEGINS_AGAIN, (STARTED, dict(carried=True)), FIX),
    (BEGINS_AGAIN, (NOT_STARTED, dict(dt_s=0.0)), WITHOUT_MAP),
    (CARRIED_AND_BEGINS_AGAIN, (NOT_STARTED, dict(dt_s=0.0, carried=True)), CARRIED_WITHOUT_MAP),
    (CARRIED_WITHOUT_MAP, (STARTED, dict(carried=True)), FIX),
    (CARRIED_WITHOUT_MAP, (STARTED, dict()), replace(ROUGH, resets=1)),
    (WITHOUT_MAP, (STARTED, dict(carried=True)), replace(ROUGH, resets=1)),
    (WITHOUT_MAP, (NOT_STARTED, dict(dt_s=0.0, carried=True)), replace(WITHOUT_MAP, state=DEGRADED)),
]


@pytest.mark.parametrize(("before", "frame", "after"), TRANSITIONS)
def test_transition(before: TrackingStatus, frame: tuple[str, dict[str, Any]], after: TrackingStatus) -> None:
    name, facts = frame
    limits = {"limits": LIMITS} if name in (ACCEPTED, REFUSED) else {}
    assert getattr(before, name)(**facts, **limits) == after


@pytest.mark.parametrize(("dt_s", "lost", "started_again"), [(0.25, 2, 4), (0.125, 3, 7), (0.0625, 5, 13)])
def test_times_and_not_frames_decide(dt_s: float, lost: int, started_again: int) -> None:
    limits, status, seen = replace(LIMITS, restart_s=0.5), FIX, []
    for _ in range(started_again):
        status = status.refused(dt_s, limits)
        seen.append(status)
    assert [status.state for status in seen] == [DEGRADED] * (lost - 1) + [LOST] * (started_again - lost + 1)
    assert [status.restart for status in seen] == [False] * (started_again - 1) + [True]
