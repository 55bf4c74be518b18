"""Motions that the base has followed: the pose to which they lead, and how far they reach back."""

from __future__ import annotations

import math

import pytest

from omnid.core.control.driven_motions import MOST_MOTIONS, DrivenMotions
from omnid.core.control.heading_controller import Twist

S = 1_000_000_000


def test_a_way_begins_at_the_stamp_and_lasts_until_now() -> None:
    motions = DrivenMotions()
    motions.add(1 * S, Twist(1.0))
    motions.add(3 * S, Twist(0.0, math.pi / 2))
    motions.add(4 * S, Twist(2.0))
    # One second straight on, a quarter of a turn to the left, half a second straight on.
    pose = motions.since(2 * S, 4 * S + S // 2)
    assert pose == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_motion_that_is_forgotten_is_not_reached() -> None:
    motions = DrivenMotions()
    for tick in range(MOST_MOTIONS):
        assert motions.reach_back_to(5)
        motions.add(10 + tick, Twist(1.0))
    assert motions.reach_back_to(10)
    motions.add(10 + MOST_MOTIONS, Twist(1.0))
    assert not motions.reach_back_to(10) and motions.reach_back_to(11)
