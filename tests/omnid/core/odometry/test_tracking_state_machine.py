"""The tracking state: a table of transitions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from omnid.core.odometry.limits import OdometryLimits
from omnid.core.odometry.tracking_state_machine import FrameFacts, FrameOutcome, TrackingStatus, next_status
from omnid.tracking_state import TrackingState

LIMITS = OdometryLimits(good_inliers=50, lost_after=3, restart_after=2, max_gap_s=0.5)
DT_S = 0.125

TRACKING, DEGRADED, LOST = TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST
STARTED, NOT_STARTED, ACCEPTED, REFUSED = FrameOutcome

FIRST = TrackingStatus()
FIX = TrackingStatus(TRACKING)
REFUSED_ONCE = TrackingStatus(DEGRADED, 1, 0, DT_S)
REFUSED_TWICE = TrackingStatus(DEGRADED, 2, 0, 2 * DT_S)
DARK = TrackingStatus(LOST, 3, 0, 3 * DT_S)
UNMATCHED = TrackingStatus(LOST, 4, 1, 4 * DT_S)

TRANSITIONS = [
    # before, frame, after
    (FIRST, FrameFacts(STARTED, 0.0), FIX),
    (FIRST, FrameFacts(NOT_STARTED, DT_S), TrackingStatus(LOST, 0, 0, DT_S)),
    (TrackingStatus(LOST, 0, 0, DT_S), FrameFacts(NOT_STARTED, DT_S), TrackingStatus(LOST, 0, 0, 2 * DT_S)),
    (TrackingStatus(LOST, 0, 0, DT_S), FrameFacts(STARTED, DT_S), FIX),
    (FIX, FrameFacts(ACCEPTED, DT_S, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, DT_S, inliers=49), TrackingStatus(DEGRADED)),
    (TrackingStatus(DEGRADED), FrameFacts(ACCEPTED, DT_S, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, 0.5, inliers=50), FIX),
    (FIX, FrameFacts(ACCEPTED, 0.75, inliers=50), TrackingStatus(DEGRADED)),
    (FIX, FrameFacts(REFUSED, DT_S), REFUSED_ONCE),
    (REFUSED_ONCE, FrameFacts(ACCEPTED, DT_S, inliers=200), TrackingStatus(DEGRADED)),
    (REFUSED_ONCE, FrameFacts(REFUSED, DT_S), REFUSED_TWICE),
    (REFUSED_TWICE, FrameFacts(REFUSED, DT_S, textured=False), DARK),
    (DARK, FrameFacts(REFUSED, DT_S, textured=False), TrackingStatus(LOST, 4, 0, 4 * DT_S)),
    (DARK, FrameFacts(REFUSED, DT_S), UNMATCHED),
    (UNMATCHED, FrameFacts(REFUSED, DT_S, textured=False), TrackingStatus(LOST, 5, 1, 5 * DT_S)),
    (UNMATCHED, FrameFacts(REFUSED, DT_S), TrackingStatus(LOST, 5, 2, 5 * DT_S, restart=True)),
    (REFUSED_ONCE, FrameFacts(REFUSED, DT_S, elsewhere=True), REFUSED_TWICE),
    (DARK, FrameFacts(REFUSED, DT_S, elsewhere=True), replace(UNMATCHED, restart=True)),
    (UNMATCHED, FrameFacts(ACCEPTED, DT_S, inliers=200), TrackingStatus(DEGRADED)),
    (REFUSED_TWICE, FrameFacts(REFUSED, DT_S, textured=False, carried=True), replace(DARK, state=DEGRADED)),
    (UNMATCHED, FrameFacts(REFUSED, DT_S, carried=True), TrackingStatus(DEGRADED, 5, 2, 5 * DT_S, restart=True)),
    (FIX, FrameFacts(NOT_STARTED, DT_S, carried=True), TrackingStatus(DEGRADED, 0, 0, DT_S)),
    (TrackingStatus(LOST, 5, 2, 5 * DT_S, restart=True), FrameFacts(STARTED, 0.0), TrackingStatus(DEGRADED)),
    (TrackingStatus(LOST, 5, 2, 5 * DT_S, restart=True), FrameFacts(STARTED, 0.0, elsewhere=True), FIX),
    (TrackingStatus(DEGRADED, 5, 2, 5 * DT_S, restart=True), FrameFacts(STARTED, 0.0, carried=True), FIX),
    (
        TrackingStatus(LOST, 5, 2, 5 * DT_S, restart=True),
        FrameFacts(NOT_STARTED, 0.0),
        TrackingStatus(LOST, 0, 0, 5 * DT_S),
    ),
]


@pytest.mark.parametrize(("before", "facts", "after"), TRANSITIONS)
def test_transition(before: TrackingStatus, facts: FrameFacts, after: TrackingStatus) -> None:
    assert next_status(before, facts, LIMITS) == after


def test_the_first_refused_frame_is_lost_where_one_is_enough() -> None:
    limits = OdometryLimits(lost_after=1, restart_after=1)
    assert next_status(FIX, FrameFacts(REFUSED, DT_S, textured=False), limits) == TrackingStatus(LOST, 1, 0, DT_S)
    assert next_status(FIX, FrameFacts(REFUSED, DT_S), limits).restart
