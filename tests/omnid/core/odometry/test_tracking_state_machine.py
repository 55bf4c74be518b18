"""The tracking state: a table of transitions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.tracking_state_machine import FrameFacts, FrameOutcome, TrackingStatus, next_status
from omnid.tracking_state import TrackingState

DT_S = 0.125
# Lost from the third refused frame on, and started again at the second unmatched one.
LIMITS = OdometryLimits(good_inliers=50, lost_s=0.2, restart_s=0.1, max_gap_s=0.5)

TRACKING, DEGRADED, LOST = TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST
STARTED, NOT_STARTED, ACCEPTED, REFUSED = FrameOutcome

FIRST = TrackingStatus()
FIX = TrackingStatus(TRACKING, has_begun=True)
ROUGH = replace(FIX, state=DEGRADED)


def refused(state: TrackingState, frames: int, unmatched: int = 0, **facts: bool) -> TrackingStatus:
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
    (FIRST, FrameFacts(STARTED, 0.0), FIX),
    (FIRST, FrameFacts(NOT_STARTED, DT_S), TrackingStatus(LOST, time_since_fix_s=DT_S)),
    (
        TrackingStatus(LOST, time_since_fix_s=DT_S),
        FrameFacts(NOT_STARTED, DT_S),
        TrackingStatus(LOST, time_since_fix_s=2 * DT_S),
    ),
    (TrackingStatus(LOST, time_since_fix_s=DT_S), FrameFacts(STARTED, DT_S), FIX),
    (FIX, FrameFacts(ACCEPTED, DT_S, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, DT_S, inliers=49), ROUGH),
    (ROUGH, FrameFacts(ACCEPTED, DT_S, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, DT_S, inliers=50, lower_only=True), ROUGH),
    (FIX, FrameFacts(ACCEPTED, 0.5, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, 0.75, inliers=50), ROUGH),
    (FIX, FrameFacts(REFUSED, DT_S), REFUSED_ONCE),
    (REFUSED_ONCE, FrameFacts(ACCEPTED, DT_S, inliers=200), ROUGH),
    (REFUSED_ONCE, FrameFacts(ACCEPTED, DT_S, inliers=200, turned=True), replace(ROUGH, resets=1)),
    (REFUSED_ONCE, FrameFacts(REFUSED, DT_S), REFUSED_TWICE),
    (REFUSED_TWICE, FrameFacts(REFUSED, DT_S, textured=False), DARK),
    (DARK, FrameFacts(REFUSED, DT_S, textured=False), refused(LOST, 4)),
    (DARK, FrameFacts(REFUSED, DT_S), UNMATCHED),
    (UNMATCHED, FrameFacts(REFUSED, DT_S, textured=False), refused(LOST, 5, 1)),
    (UNMATCHED, FrameFacts(REFUSED, DT_S), BEGINS_AGAIN),
    (REFUSED_ONCE, FrameFacts(REFUSED, DT_S, elsewhere=True), REFUSED_TWICE),
    (DARK, FrameFacts(REFUSED, DT_S, elsewhere=True), replace(UNMATCHED, restart=True)),
    (UNMATCHED, FrameFacts(ACCEPTED, DT_S, inliers=200), ROUGH),
    # Wheels and gyro carry the pose on; the motion is known only where they do so from the last fix on.
    (FIX, FrameFacts(REFUSED, DT_S, carried=True), refused(DEGRADED, 1, unknown_motion=False)),
    (REFUSED_TWICE, FrameFacts(REFUSED, DT_S, textured=False, carried=True), replace(DARK, state=DEGRADED)),
    (CARRIED, FrameFacts(REFUSED, DT_S, carried=True), CARRIED_AND_BEGINS_AGAIN),
    (UNMATCHED, FrameFacts(REFUSED, DT_S, carried=True), replace(BEGINS_AGAIN, state=DEGRADED)),
    # They say that it has hardly moved, and the images that the map is not in view.
    (CARRIED, FrameFacts(REFUSED, DT_S, carried=True, stayed=True), replace(BEGINS_AGAIN, state=DEGRADED)),
    (
        CARRIED,
        FrameFacts(REFUSED, DT_S, textured=False, carried=True, stayed=True),
        refused(DEGRADED, 5, 1, unknown_motion=False),
    ),
    # The map is started again.
    (BEGINS_AGAIN, FrameFacts(STARTED, 0.0), replace(ROUGH, resets=1)),
    (BEGINS_AGAIN, FrameFacts(STARTED, 0.0, elsewhere=True), ONE_RESET),
    (replace(BEGINS_AGAIN, resets=3), FrameFacts(STARTED, 0.0), replace(ROUGH, resets=4)),
    (CARRIED_AND_BEGINS_AGAIN, FrameFacts(STARTED, 0.0, carried=True), FIX),
    (BEGINS_AGAIN, FrameFacts(NOT_STARTED, 0.0), WITHOUT_MAP),
    (CARRIED_AND_BEGINS_AGAIN, FrameFacts(NOT_STARTED, 0.0, carried=True), CARRIED_WITHOUT_MAP),
    (CARRIED_WITHOUT_MAP, FrameFacts(STARTED, DT_S, carried=True), FIX),
    (CARRIED_WITHOUT_MAP, FrameFacts(STARTED, DT_S), replace(ROUGH, resets=1)),
    (WITHOUT_MAP, FrameFacts(STARTED, DT_S, carried=True), replace(ROUGH, resets=1)),
    (WITHOUT_MAP, FrameFacts(NOT_STARTED, 0.0, carried=True), replace(WITHOUT_MAP, state=DEGRADED)),
]


@pytest.mark.parametrize(("before", "facts", "after"), TRANSITIONS)
def test_transition(before: TrackingStatus, facts: FrameFacts, after: TrackingStatus) -> None:
    assert next_status(before, facts, LIMITS) == after


@pytest.mark.parametrize(("dt_s", "lost", "started_again"), [(0.25, 2, 4), (0.125, 3, 7), (0.0625, 5, 13)])
def test_times_and_not_frames_decide(dt_s: float, lost: int, started_again: int) -> None:
    limits, status, seen = replace(LIMITS, restart_s=0.5), FIX, []
    for _ in range(started_again):
        status = next_status(status, FrameFacts(REFUSED, dt_s), limits)
        seen.append(status)
    assert [status.state for status in seen] == [DEGRADED] * (lost - 1) + [LOST] * (started_again - lost + 1)
    assert [status.restart for status in seen] == [False] * (started_again - 1) + [True]
