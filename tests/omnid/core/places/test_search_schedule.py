"""Schedule of keyframes and of searches for places."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calib import se3
from omnid.core.places.hypotheses import SEARCH_NS, SEARCHES, WAIT_FACTOR, SearchSchedule
from omnid.core.places.place_map import PlaceLimits
from tests.omnid.core.places.test_place_map import keyframe

S = 1_000_000_000
LIMITS = PlaceLimits(rate_hz=1.0, keyframe_m=0.5, keyframe_deg=20.0)


def forward(x_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    return se3.exp([x_m, 0.0, 0.0, 0.0, 0.0, yaw_rad])


def test_a_keyframe_is_due_by_distance_or_by_turn_and_not_too_often() -> None:
    newest = replace(keyframe(0), stamp_ns=0, T_odom_rect=np.eye(4))
    due = SearchSchedule(LIMITS).keyframe_is_due
    assert due(None, 0, np.eye(4), has_depth=False)
    assert not due(newest, 2 * S, forward(0.49), has_depth=True) and due(newest, 2 * S, forward(0.51), has_depth=True)
    assert due(newest, 2 * S, forward(0.0, math.radians(21)), has_depth=True)
    assert not due(newest, S // 2, forward(5.0), has_depth=True)
    assert not due(newest, 2 * S, forward(0.9), has_depth=False)
    assert due(newest, 2 * S, forward(0.51 * WAIT_FACTOR), has_depth=False)


def test_searches_go_on_while_the_place_is_unknown_and_end_after_some() -> None:
    schedule, due = SearchSchedule(LIMITS), []
    for k in range(3 * SEARCHES):
        stamp_ns = k * SEARCH_NS
        due.append(schedule.search_is_due(stamp_ns, np.eye(4), is_unknown=True, is_pending=False))
        if due[-1]:
            schedule.begin(stamp_ns, np.eye(4))
            schedule.end(found=False, could_find=True)
    assert due == [True] * SEARCHES + [False] * 2 * SEARCHES


def test_the_dark_counts_as_no_failure_and_a_place_that_is_found_ends_them() -> None:
    schedule = SearchSchedule(LIMITS)

    def is_due() -> bool:
        return schedule.search_is_due(SEARCH_NS, np.eye(4), is_unknown=True, is_pending=False)

    schedule.begin(0, np.eye(4))
    for _ in range(2 * SEARCHES):
        schedule.end(found=False, could_find=False)
    assert is_due()
    for _ in range(SEARCHES):
        schedule.end(found=False, could_find=True)
    assert not is_due()
    schedule.end(found=True, could_find=True)
    assert is_due()


def test_a_recognition_is_checked_in_a_frame_that_has_moved() -> None:
    schedule = SearchSchedule(LIMITS)
    assert schedule.search_is_due(0, np.eye(4), is_unknown=False, is_pending=False)
    schedule.begin(0, np.eye(4))
    asked = [
        schedule.search_is_due(S, forward(x_m), is_unknown=False, is_pending=pending)
        for x_m, pending in ((0.2, False), (0.05, True), (0.2, True))
    ]
    assert asked == [False, False, True]
    assert not schedule.search_is_due(SEARCH_NS - 1, forward(0.2), is_unknown=True, is_pending=True)
