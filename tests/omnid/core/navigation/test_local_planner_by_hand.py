"""Single decisions of the local planner, calculated by hand or by a slower way: arcs, detours, waits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.se2_arrays import composed
from omnid.core.control.collision_settings import CollisionSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.forecast import Forecast
from omnid.core.navigation.grid_ways import (
    CELL_M,
    FAR_M,
    HALF_CELLS,
    descent,
    grid_distances,
    neighbours,
    to_cells,
    wave_front,
)
from omnid.core.navigation.local_planner import CROSSES, STANDS, Detour, LocalPlanner, _rejoin
from omnid.core.navigation.settings import NavigationSettings
from tests.omnid.core.navigation.test_local_planner import OUTLINE, SETTINGS, arcs

Array = NDArray[np.float64]
PATH = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
ON_THE_PATH = NavigationSettings(corridor_m=0.0)
WANTED = Setpoint(0.4, None, 0.3)
HALF_M = OUTLINE.half_width_m + OUTLINE.side_m


def points(*rows: tuple[float, float, float, float]) -> Array:
    """Return points every 5 cm on lines (x0, y0, x1, y1)."""
    lines = [np.linspace(row[:2], row[2:], max(2, round(math.dist(row[:2], row[2:]) / 0.05) + 1)) for row in rows]
    return np.vstack(lines)


def cheapest_arc(planner: LocalPlanner, pose: Array, obstacles: Array, goal: Array) -> tuple[float, float] | None:
    """Return speed and yaw rate of the arc of least cost, one arc after the other, among obstacles not too near yet."""
    corner = pose[:2] - HALF_CELLS * CELL_M
    room_m = grid_distances(obstacles, corner)
    is_free = (room_m > HALF_M + 0.05) & (grid_distances(PATH, corner) <= 0.8)
    is_free[HALF_CELLS, HALF_CELLS] = True
    wide_m = HALF_M + 0.3
    narrow = np.clip(1.0 - room_m / wide_m, 0.0, 1.0)
    left_m = wave_front(neighbours(), is_free, 1.0 + 2.0 * narrow, to_cells(goal[None], corner)[0])
    assert left_m is not None
    costs = {}
    for motion, places in zip(*arcs(planner), strict=True):
        places = composed(pose[None], places)
        cells = to_cells(places[:, :2], corner)
        column, row = cells[-1]
        if not motion.any() or not is_free[row, column] or left_m[row, column] >= FAR_M:
            continue
        reach_m = (0.25 + (0.17 if motion[0] > 0 else 0.02), 0.25 + (0.17 if motion[0] < 0 else 0.02))
        to = obstacles - places[:, None, :2]
        cos, sin = np.cos(places[:, None, 2]), np.sin(places[:, None, 2])
        x, y = cos * to[..., 0] + sin * to[..., 1], cos * to[..., 1] - sin * to[..., 0]
        if ((-reach_m[1] < x) & (x < reach_m[0]) & (abs(y) < HALF_M + 0.02)).any():
            continue
        down = descent(left_m, np.array([row]), np.array([column]))[0]
        costs[tuple(motion)] = (
            left_m[row, column]
            + 0.25 * abs(math.remainder(places[-1, 2] - down, math.tau))
            + (0.5 if motion[0] < 0 else 0.0)
            + 0.4 * narrow[cells[:, 1], cells[:, 0]].max()
        )
    return min(costs, key=lambda motion: costs[motion]) if costs else None


@pytest.mark.parametrize(
    ("pose", "obstacles"),
    [
        ((0.0, 0.0, 0.0), points((1.1, -0.2, 1.1, 0.1))),
        ((0.3, -0.4, 2.6), points((1.2, -0.1, 1.2, 0.6), (0.3, -1.2, 2.0, -1.2))),
        ((-0.1, 0.1, 0.5), points((0.6, -0.6, 0.6, 0.1), (1.4, 0.2, 1.4, 0.8))),
        ((0.0, 0.0, 3.1), points((0.65, -0.7, 0.65, 0.3), (-0.1, -0.65, 0.6, -0.65), (0.0, 0.6, -0.5, 0.6))),
    ],
)
def test_a_detour_takes_the_arc_of_least_cost(pose: tuple[float, float, float], obstacles: Array) -> None:
    planner, place, goal = LocalPlanner(SETTINGS, OUTLINE), np.array(pose), np.array([2.2, 0.0])
    motion = planner._around(place, PATH, obstacles, goal, None)
    assert motion is not None and motion.heading_rad is None
    assert (motion.velocity_mps, motion.yaw_rate_radps) == cheapest_arc(planner, place, obstacles, goal)


@pytest.mark.parametrize(("half_gap_m", "passes"), [(HALF_M, False), (HALF_M + 0.09, True)])
def test_a_detour_needs_half_of_the_clearance_beside_the_base(half_gap_m: float, passes: bool) -> None:
    walls = points((1.2, half_gap_m, 1.2, 3.0), (1.2, -half_gap_m, 1.2, -3.0))
    motion = LocalPlanner(SETTINGS, OUTLINE)._around(np.array([0.0, 0.3, 0.0]), PATH, walls, np.array([2.2, 0.0]), None)
    assert (motion is not None) == passes


def test_a_base_in_a_dead_end_backs_out_of_it_at_12_cm_per_second() -> None:
    dead_end = points((0.42, -0.29, 0.42, 0.29), (-0.4, 0.29, 0.42, 0.29), (-0.4, -0.29, 0.42, -0.29))
    detour = LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), PATH, dead_end, WANTED)
    assert detour == Detour(Setpoint(-0.12, None, 0.0), True)


@pytest.mark.parametrize(("place_m", "left_m"), [(0.9, None), (1.2, 0.25), (1.35, 0.4), (1.5, math.inf)])
def test_it_drives_up_to_what_stands_on_the_path_so_that_it_can_wait_35_cm_before_it(
    place_m: float, left_m: float | None
) -> None:
    there = np.array([2.0, -3.0, 0.0])
    box = np.array([(place_m, 0.0)]) + there[:2]
    detour = LocalPlanner(ON_THE_PATH, OUTLINE).plan(there, PATH + there[:2], box, WANTED)
    if left_m is None:
        assert detour == Detour(None, False, STANDS)
    else:
        speed_mps = min(0.4, math.sqrt(2 * 0.2 * left_m))
        assert detour == Detour(detour.setpoint, False) and detour.setpoint is not None
        assert detour.setpoint.velocity_mps == pytest.approx(speed_mps)
        assert detour.setpoint.yaw_rate_radps == pytest.approx(0.3 * speed_mps / 0.4), "on the same arc"


@pytest.mark.parametrize(
    ("leg_left_m", "place_m", "counts"),
    [(0.32, 0.6, True), (0.32, 0.68, True), (0.32, 0.79, False), (9.0, 2.3, True), (9.0, 2.5, False)],
)
def test_what_stands_beyond_the_next_corner_or_two_metres_does_not_matter_yet(
    leg_left_m: float, place_m: float, counts: bool
) -> None:
    planner = LocalPlanner(SETTINGS, OUTLINE)
    detour = planner.plan(np.zeros(3), PATH, np.array([(place_m, 0.0)]), WANTED, leg_left_m=leg_left_m)
    assert (detour == Detour(WANTED, False)) != counts


def test_a_new_drive_does_not_know_of_the_detour_of_the_last_one() -> None:
    planner, beside = LocalPlanner(SETTINGS, OUTLINE), np.array([0.0, 0.5, 0.0])
    far = np.array([(5.0, 5.0)])
    assert planner.plan(np.zeros(3), PATH, points((1.1, -0.1, 1.1, 0.1)), WANTED).avoiding
    assert planner.plan(beside, PATH, far, WANTED).avoiding, "it comes back to the path"
    planner.restart()
    assert planner.plan(beside, PATH, far, WANTED) == Detour(WANTED, False)
    assert LocalPlanner(SETTINGS, OUTLINE).plan(beside, PATH, far, WANTED) == Detour(WANTED, False)


def test_a_turn_on_the_spot_neither_begins_nor_ends_a_detour() -> None:
    beside, far = np.array([0.0, 0.5, 0.0]), np.array([(5.0, 5.0)])
    planner = LocalPlanner(SETTINGS, OUTLINE)
    turn = Setpoint(0.0, 1.0)
    assert planner.plan(beside, PATH, far, turn) == Detour(turn, False)
    assert planner.plan(beside, PATH, far, WANTED) == Detour(WANTED, False)
    assert planner.plan(np.zeros(3), PATH, points((1.1, -0.1, 1.1, 0.1)), WANTED).avoiding
    assert planner.plan(beside, PATH, far, turn).avoiding
    assert planner.plan(beside, PATH, np.zeros((0, 2)), WANTED) == Detour(WANTED, False), "nothing is there any more"
    assert planner.plan(beside, PATH, far, WANTED) == Detour(WANTED, False)


def test_what_stands_just_behind_the_base_does_not_hold_it() -> None:
    planner = LocalPlanner(SETTINGS, OUTLINE)
    for also in ([], [(3.9, 0.0)]):
        seen = np.array([(-0.33, 0.0), *also])
        assert planner.plan(np.zeros(3), PATH, seen, WANTED) == Detour(WANTED, False), "nor what stands far ahead"


@pytest.mark.parametrize(("front_m", "rear_m"), [(0.2, 0.4), (0.4, 0.2)])
def test_the_ends_of_the_base_may_differ(front_m: float, rear_m: float) -> None:
    planner = LocalPlanner(SETTINGS, CollisionSettings(front_m=front_m, rear_m=rear_m))
    straight = planner._w == 0
    for x_m, towards in ((front_m + 0.02, planner._v > 0), (-rear_m - 0.02, planner._v < 0)):
        may = planner._keeps_clear(np.zeros(3), np.array([(x_m, 0.0)]))
        assert not may[straight & towards].any() and may[straight & ~towards].all()


def test_a_detour_ends_within_12_cm_of_the_path() -> None:
    planner, far = LocalPlanner(SETTINGS, OUTLINE), np.array([(5.0, 5.0)])
    assert planner.plan(np.zeros(3), PATH, points((1.1, -0.1, 1.1, 0.1)), WANTED).avoiding
    assert planner.plan(np.array([0.0, -0.13, 0.0]), PATH, far, WANTED).avoiding
    assert planner.plan(np.array([0.0, -0.11, 0.0]), PATH, far, WANTED) == Detour(WANTED, False)
    assert planner.plan(np.array([0.0, -0.13, 0.0]), PATH, far, WANTED) == Detour(WANTED, False)


def test_there_is_no_detour_to_an_occupied_place_at_the_border_of_what_is_planned() -> None:
    path, box = np.add(PATH, (0.8, 0.0)), points((2.3, 0.0, 2.95, 0.0))
    assert LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), path, box, WANTED) == Detour(WANTED, False)


def test_a_base_beside_a_wall_that_is_too_near_drives_on_along_it() -> None:
    planner = LocalPlanner(SETTINGS, OUTLINE)
    wall = np.column_stack([np.arange(-1.0, 6.0, 0.05), np.full(140, 0.3)])
    assert planner.plan(np.zeros(3), PATH, wall, WANTED) == Detour(WANTED, False)
    wall[22:, 1] = 0.29  # it comes nearer within the first 30 cm
    assert planner.plan(np.zeros(3), PATH, wall, WANTED) != Detour(WANTED, False)


@pytest.mark.parametrize(
    ("blocked", "length", "end"),
    [
        ([(10, 15)], 80, 19),  # 30 cm behind the begin of the obstacle, and half of 30 cm free path on
        ([(10, 20)], 80, 23),
        ([(10, 15), (18, 22)], 80, 25),  # between both it is free for 15 cm only
        ([(10, 15)], 16, 15),  # the path ends behind it
        ([(10, 15)], 18, 17),
        ([(10, 80)], 80, None),
        ([(10, 62)], 80, None),  # farther than 3 m
    ],
)
def test_a_detour_ends_where_30_cm_of_the_path_are_free(
    blocked: list[tuple[int, int]], length: int, end: int | None
) -> None:
    is_blocked = np.zeros(length, bool)
    for first, last in blocked:
        is_blocked[first:last] = True
    assert _rejoin(0.05 * np.arange(length), is_blocked, 0.5) == end


def walking(x_m: float, y_m: float, vx_mps: float, vy_mps: float) -> Forecast:
    """Return the forecast of a person whose place and velocity are known well."""
    return Forecast(np.array([(x_m, y_m)]), np.array([(vx_mps, vy_mps)]), np.array([0.2]), np.full((1, 3), 1e-8))


@pytest.mark.parametrize(
    ("settings", "beside_m", "waits"),
    [
        (SETTINGS, 0.585, True),
        (SETTINGS, 0.62, False),
        (NavigationSettings(clearance_m=0.3), 0.74, True),
        (NavigationSettings(clearance_m=0.3), 0.78, False),
    ],
)
def test_the_base_lets_pass_who_comes_into_its_clearance_or_the_room_that_the_collision_monitor_demands(
    settings: NavigationSettings, beside_m: float, waits: bool
) -> None:
    person = walking(1.5, beside_m, -0.5, 0.0)
    wanted = Setpoint(0.4, None, 0.2)
    detour = LocalPlanner(settings, OUTLINE).plan(np.zeros(3), PATH, person.xy, wanted, moving=person, speed_mps=0.4)
    if waits:
        assert detour == Detour(None, False, CROSSES)
    else:
        assert detour == Detour(wanted, False)


def test_the_base_follows_a_person_on_the_same_arc_at_half_of_its_speed() -> None:
    person = walking(0.8, 0.0, 0.2, 0.0)
    detour = LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), PATH, person.xy, WANTED, moving=person, speed_mps=0.4)
    assert detour == Detour(Setpoint(0.2, None, 0.15), False, CROSSES)


def test_the_base_goes_around_who_comes_to_it_where_both_meet_at_the_speed_of_a_detour() -> None:
    person = walking(3.0, 0.0, -0.5, 0.0)
    detour = LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), PATH, person.xy, WANTED, moving=person, speed_mps=0.4)
    meeting = person.outlines(np.array([True]), np.zeros(2), 0.7 * 0.4)
    assert detour.avoiding
    assert detour.setpoint == LocalPlanner(SETTINGS, OUTLINE)._around(
        np.zeros(3), PATH, meeting, PATH[_rejoin(0.05 * np.arange(80), blocked_by(meeting), first_by(meeting))], person
    )


def blocked_by(obstacles: Array) -> NDArray[np.bool_]:
    """Return which points of the path are too near to obstacles."""
    return np.array([np.hypot(*(obstacles - point).T).min() < HALF_M + 0.1 for point in PATH])


def first_by(obstacles: Array) -> float:
    return 0.05 * int(np.argmax(blocked_by(obstacles)))
