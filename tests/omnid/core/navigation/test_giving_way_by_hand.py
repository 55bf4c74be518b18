"""Single steps of giving way: the way back, its directions, the waits at its end, and where it ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.navigation.giving_way import (
    PASS_M,
    REST_S,
    RETRY_S,
    GivingWay,
    Phase,
    Trail,
    closed,
    give_way,
    is_free,
)
from omnid.core.navigation.navigator import GIVES_WAY
from omnid.core.navigation.settings import NavigationSettings
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.test_giving_way import Blocked

Array = NDArray[np.float64]
SETTINGS = NavigationSettings()
NOTHING = np.zeros((0, 2))
WALLS = np.array([(x, side) for x in np.arange(-1.0, 6.0, 0.05) for side in (-0.6, 0.6)])


def pose(x_m: float, y_m: float = 0.0) -> Array:
    return np.array([x_m, y_m, 0.0])


def driven(*pieces: tuple[float, float], length_m: float = 3.0) -> Trail:
    """Return the trail of a drive along x in pieces from, to; backwards where x falls."""
    trail = Trail(length_m)
    for start, end in pieces:
        for x_m in np.linspace(start, end, round(abs(end - start) / 0.02) + 1):
            trail.add(pose(float(x_m)), math.copysign(0.3, end - start))
    return trail


def way_back(
    trail: Trail | None = None, *, at_m: float = 4.0, stamp_s: float = 0.0, obstacles: Array = NOTHING
) -> GivingWay:
    found = give_way(trail or driven((0.0, at_m)), SETTINGS, pose(at_m), round(stamp_s * 1e9), obstacles, 0.3)
    assert found is not None
    return found


def rested_s(giving: GivingWay, at: Array, step_s: float, is_open: Callable[[float], bool] = lambda _: True) -> float:
    """Let it rest at a pose until it moves on; return how long it took [s]."""
    giving.rest()
    for count in range(1, 200):
        assert giving.move_on(at, step_s, is_open(count * step_s))
        if giving.phase is not Phase.REST:
            return count * step_s
    raise AssertionError("it rests for ever")


def test_a_trail_keeps_places_10_cm_apart_and_no_more_than_its_length() -> None:
    xy, backwards = driven((0.0, 5.0)).back(pose(5.0))
    np.testing.assert_allclose(xy[0], (5.0, 0.0))
    steps = -np.diff(xy[1:, 0])
    assert (steps > 0.099).all() and (steps < 0.125).all()
    assert 2.9 < xy[1, 0] - xy[-1, 0] < 3.9
    assert backwards.all(), "it came there forwards"


def test_a_trail_in_any_direction_leads_back_along_it() -> None:
    trail = Trail(3.0)
    for s_m in np.arange(0.0, 2.0, 0.02):
        trail.add(np.array([1.0 + 0.6 * s_m, 0.8 * s_m - 3.0, math.atan2(0.8, 0.6)]), 0.3)
    xy, _ = trail.back(np.array([2.2, -1.4, math.atan2(0.8, 0.6)]))
    np.testing.assert_allclose(xy[0], (2.2, -1.4))
    np.testing.assert_allclose((xy[:, 0] - 1.0) / 0.6, (xy[:, 1] + 3.0) / 0.8, atol=1e-9)
    assert math.dist(xy[0], xy[-1]) == pytest.approx(2.0)


def test_what_was_driven_backwards_is_driven_forwards_on_the_way_back() -> None:
    trail = driven((0.0, 2.0), (2.0, 1.0))
    xy, backwards = trail.back(pose(0.95))
    turn = int(xy[:, 0].argmax())
    assert xy[turn, 0] == pytest.approx(2.0, abs=0.11)
    assert not backwards[: turn - 1].any() and backwards[turn + 2 :].all()
    trail.restart()
    np.testing.assert_allclose(trail.back(pose(1.0))[0], [(1.0, 0.0)])


def test_the_way_back_and_the_return_are_driven_in_opposite_directions() -> None:
    giving = way_back(driven((0.0, 4.0)), obstacles=WALLS)
    assert [leg.backwards for leg in giving.follower.path.legs] == [True]
    rested_s(giving, pose(1.0), 1.0)
    (leg,) = giving.follower.path.legs
    assert not leg.backwards and leg.xy[0, 0] == pytest.approx(1.0, abs=0.06) and leg.xy[-1, 0] == pytest.approx(4.0)
    assert leg.speed_at(1.0) == pytest.approx(0.2)


def test_a_way_back_with_a_change_of_direction_is_returned_with_it() -> None:
    trail = driven((0.0, 2.0), (2.0, 1.0))
    giving = give_way(trail, SETTINGS, pose(0.95), 0, WALLS, 0.3)
    assert giving is not None
    assert [leg.backwards for leg in giving.follower.path.legs] == [False, True]
    end_m = float(giving.follower.path.goal[0])
    rested_s(giving, pose(end_m), 1.0)
    there, back = giving.follower.path.legs
    assert (there.backwards, back.backwards) == (False, True)
    assert there.xy[-1, 0] == pytest.approx(2.0, abs=0.11) and back.xy[-1, 0] == pytest.approx(0.95)


@pytest.mark.parametrize(("left_m", "ends"), [(0.11, False), (0.09, True)])
def test_the_way_back_ends_10_cm_before_its_last_place(left_m: float, ends: bool) -> None:
    giving = way_back()
    end_m = float(giving.follower.path.goal[0])
    giving.drive(0, pose(3.5), 0.0, 0.0)
    assert (giving.drive(10**8, pose(end_m + left_m), 0.0, 0.0) is None) == ends


def test_one_metre_of_the_way_back_must_be_free() -> None:
    giving = way_back(obstacles=WALLS)
    giving.drive(0, pose(3.5), 0.0, 0.0)
    back = giving.look_back()
    assert back[0, 0] == pytest.approx(3.5, abs=0.03) and back[-1, 0] == pytest.approx(2.5, abs=0.06)


@pytest.mark.parametrize(("stamp_s", "rest_s"), [(0.9, 3.0), (1.0, 4.0), (6.5, 5.0), (3.0, 6.0), (4.0, 3.0)])
def test_two_robots_that_met_rest_for_different_times(stamp_s: float, rest_s: float) -> None:
    assert rested_s(way_back(stamp_s=stamp_s), pose(3.0), 0.25) == rest_s


def test_the_way_must_be_free_for_a_whole_second() -> None:
    waited_s = rested_s(way_back(), pose(3.0), 0.25, lambda t_s: t_s >= 6.0 or t_s % 1.0 < 0.6)
    assert waited_s == 6.75, "from 6 s on, at each step"


def test_at_the_place_of_the_block_there_is_no_way_to_return() -> None:
    giving = way_back()
    giving.rest()
    answers = [giving.move_on(pose(4.0), 1.0, True) for _ in range(3)]
    assert answers == [True, True, False]


def test_blocked_at_the_far_end_of_its_return_it_stays_there() -> None:
    giving = way_back()
    rested_s(giving, pose(3.0), 1.0)
    giving.rest()
    end = giving._xy[-1]
    answers = [giving.move_on(pose(float(end[0])), 1.0, False) for _ in range(int(RETRY_S) + 1)]
    assert all(answers) and giving.phase is Phase.REST, "there is nothing to drive back"


@pytest.mark.parametrize(
    ("obstacles", "end_m"),
    [
        ([(6.0, 0.0)], 2.98),  # the first place after a metre is wide
        ([*WALLS, (9.0, 9.0)], 1.0),
        ([(x, 0.3 + PASS_M - 0.1) for x in np.arange(2.5, 6.0, 0.05)], 2.0),
    ],
)
def test_the_way_back_ends_where_others_can_pass_or_after_three_metres(
    obstacles: list[tuple[float, float]], end_m: float
) -> None:
    giving = way_back(obstacles=np.array(obstacles))
    assert giving.follower.path.goal[0] == pytest.approx(end_m, abs=0.12)


@pytest.mark.parametrize(("came_m", "gives"), [(0.2, False), (0.25, False), (0.45, True)])
def test_a_way_back_of_less_than_30_cm_makes_no_room(came_m: float, gives: bool) -> None:
    found = give_way(driven((4.0 - came_m, 4.0)), SETTINGS, pose(4.0), 0, WALLS, 0.3)
    assert (found is not None) == gives


def test_a_robot_that_has_not_moved_has_no_way_back() -> None:
    assert give_way(Trail(3.0), SETTINGS, pose(4.0), 0, NOTHING, 0.3) is None


def test_a_place_is_closed_where_the_way_back_is_too_narrow_and_gets_narrower() -> None:
    path = np.array([(x, 0.0) for x in (0.0, -0.1, -0.2, -0.3, -0.4)])
    np.testing.assert_array_equal(closed(path, np.array([(0.2, 0.0)]), 0.3), [False] * 5)
    np.testing.assert_array_equal(closed(path, np.array([(-0.45, 0.0)]), 0.3), [False, False, True, True, True])
    np.testing.assert_array_equal(closed(path, NOTHING, 0.3), [False] * 5)
    beside = np.array([(x, 0.2) for x in np.arange(-1.0, 1.0, 0.1)])
    np.testing.assert_array_equal(closed(path, beside, 0.3), [False] * 5)


def blocked_for(waited_s: float, gave_way: int = 0, gave_way_m: float = math.inf) -> Blocked:
    """Return a blocked base that has waited for a time, and has given way before where this much was left."""
    blocked = Blocked()
    drive = blocked.navigator.drive
    assert drive is not None and blocked.step().state is NavigationState.BLOCKED
    drive.waits[NavigationState.BLOCKED] = waited_s
    drive.gave_way, drive.gave_way_m = gave_way, gave_way_m
    return blocked


@pytest.mark.parametrize(
    ("waited_s", "gave_way", "gave_way_m", "gives"),
    [
        (3.95, 0, math.inf, True),
        (3.95, 1, 3.95, False),
        (7.95, 1, 3.95, True),
        (3.95, 1, 4.05, True),
        (4.0 * 2**6 - 0.05, 40, 3.0, True),
        (4.0 * 2**6 - 0.5, 40, 3.0, False),
    ],
)
def test_the_wait_doubles_at_the_same_block_up_to_a_limit_and_a_block_one_metre_on_is_a_new_one(
    waited_s: float, gave_way: int, gave_way_m: float, gives: bool
) -> None:
    blocked = blocked_for(waited_s, gave_way, gave_way_m)
    assert (GIVES_WAY in [blocked.step().reason for _ in range(3)]) == gives


def test_how_often_it_gave_way_is_counted_with_the_place() -> None:
    blocked = blocked_for(4.0)
    blocked.wait()
    assert blocked.navigator.drive is not None
    assert blocked.navigator.drive.gave_way == 1 and blocked.navigator.drive.gave_way_m == pytest.approx(3.0)
    assert blocked.step(1.9).left_m == pytest.approx(3.0), "it tells the way that is left from the block"


@pytest.mark.parametrize(
    ("place", "looks"), [((2.3, 0.3), True), ((2.3, 0.4), False), ((2.9, -0.2), True), ((3.45, 0.0), False)]
)
def test_it_comes_again_where_the_way_and_a_metre_past_the_block_have_room_or_later_to_look(
    place: tuple[float, float], looks: bool
) -> None:
    blocked, waited_s = blocked_for(4.0), 0.0
    blocked.wait()
    blocked.giving.rest()
    blocked.obstacles = np.array([place])
    while blocked.giving.phase is Phase.REST and waited_s < 2 * RETRY_S:
        assert blocked.step(1.5).setpoint is not None
        waited_s += 0.1
    assert blocked.giving.phase is Phase.RETURN
    assert (waited_s > RETRY_S - 0.15) == looks and waited_s > REST_S - 0.15


def test_a_path_is_free_that_keeps_its_room_everywhere() -> None:
    path = np.array([(0.0, 0.0), (0.5, 0.0), (1.0, 0.0)])
    assert is_free(path, NOTHING, 0.3) and is_free(path, np.array([(0.5, 0.31)]), 0.3)
    assert not is_free(path, np.array([(5.0, 0.0), (1.0, -0.29)]), 0.3)
    elsewhere = np.array([-3.0, 2.0])
    for place, keeps in (((0.5, 0.31), True), ((0.5, 0.29), False)):
        assert is_free(path + elsewhere, np.array([place]) + elsewhere, 0.3) == keeps
