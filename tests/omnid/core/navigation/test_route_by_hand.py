"""Single properties of routes: speeds and directions in both orders, rounds, turns on the spot, bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.se2_arrays import composed
from omnid.core.navigation.path import MAX_LENGTH_M
from omnid.core.navigation.route import MOST_POINTS, KeyframePose, Route, RouteRecorder, repeated_paths
from omnid.errors import OmnidError

Array = NDArray[np.float64]
ORIGIN = KeyframePose(5, np.zeros(3))


def only_keyframe(id: int) -> KeyframePose | None:
    return ORIGIN if id == 1 else None


def straight(*speeds: tuple[float, float, float]) -> Route:
    """Return a route along x with pieces from, to, speed."""
    recorder = RouteRecorder("hall")
    for start, end, speed_mps in speeds:
        for x_m in np.linspace(start, end, round(abs(end - start) / 0.02) + 1):
            recorder.add(np.array([x_m, 0.0, 0.0]), speed_mps, 1, np.zeros(3))
    return recorder.route(only_keyframe, {1: 5}, 7, "site.omap")


def test_each_part_is_repeated_with_its_speed_in_both_orders() -> None:
    route = straight((0.0, 2.0, 0.2), (2.02, 4.0, 0.4))
    ((leg,),) = (path.legs for path in repeated_paths(route, only_keyframe, np.zeros(3), loops=1, reverse=False))
    assert [leg.speed_at(s_m) for s_m in (0.5, 1.8, 2.3, 3.5)] == [0.2, 0.2, 0.4, 0.4]
    end = np.array([4.0, 0.0, math.pi])
    (path,) = repeated_paths(route, only_keyframe, end, loops=1, reverse=True)
    (leg,) = path.legs
    assert [leg.speed_at(s_m) for s_m in (0.5, 1.7, 2.2, 3.5)] == [0.4, 0.4, 0.2, 0.2]
    assert not leg.backwards and abs(path.final_heading_rad or 0.0) == pytest.approx(math.pi)
    np.testing.assert_allclose(path.goal, (0.0, 0.0), atol=1e-6)


def test_the_speed_of_a_step_stays_with_it_when_the_order_is_reversed() -> None:
    route = straight((0.0, 2.0, 0.2), (2.02, 4.0, 0.4))
    back = route.reversed()
    for k in range(1, len(route.speeds)):
        assert back.speeds[len(route.speeds) - k] == route.speeds[k]
    np.testing.assert_allclose(back.reversed().poses[:, :2], route.poses[:, :2])


def test_slow_parts_are_repeated_with_10_cm_per_second_forwards_or_backwards() -> None:
    route = straight((0.0, 2.0, 0.03), (1.98, 0.0, -0.03))
    there, back = repeated_paths(route, only_keyframe, np.zeros(3), loops=1, reverse=False)[0].legs
    assert (there.backwards, back.backwards) == (False, True)
    assert there.speed.max() == pytest.approx(0.1) and back.speed.max() == pytest.approx(0.1)


def test_a_route_with_two_ends_is_driven_there_and_back_by_turns() -> None:
    route = straight((0.0, 3.0, 0.3))
    paths = repeated_paths(route, only_keyframe, np.zeros(3), loops=4, reverse=False)
    assert [round(float(path.goal[0])) for path in paths] == [3, 0, 3, 0]
    paths = repeated_paths(route, only_keyframe, np.array([3.0, 0.0, math.pi]), loops=3, reverse=True)
    assert [round(float(path.goal[0])) for path in paths] == [0, 3, 0]
    assert all(not leg.backwards for path in paths for leg in path.legs)
    assert [path.length_m for path in paths] == pytest.approx([3.0, 3.0, 3.0])


def test_a_turn_on_the_spot_is_recorded_every_10_degrees_and_adds_no_length() -> None:
    recorder = RouteRecorder("hall")
    for turned_deg in range(91):
        recorder.add(np.array([0.0, 0.0, math.radians(turned_deg)]), 0.0, 1, np.zeros(3))
    headings = np.degrees([point[0][2] for point in recorder._points])
    assert np.diff(headings).min() >= 10.0 and np.diff(headings).max() <= 11.0
    assert recorder.length_m == 0.0


def test_a_route_is_bounded_in_points_and_length() -> None:
    recorder = RouteRecorder("hall")
    recorder.add(np.zeros(3), 0.3, 1, np.zeros(3))
    recorder._points *= MOST_POINTS - 1
    recorder.add(np.array([0.2, 0.0, 0.0]), 0.3, 1, np.zeros(3))
    with pytest.raises(OmnidError, match=f"too long: {MOST_POINTS} points"):
        recorder.add(np.array([0.4, 0.0, 0.0]), 0.3, 1, np.zeros(3))
    recorder = RouteRecorder("hall")
    recorder.add(np.zeros(3), 0.3, 1, np.zeros(3))
    with pytest.raises(OmnidError, match="too long: 1 points, 5001 m"):
        recorder.add(np.array([MAX_LENGTH_M + 1.0, 0.0, 0.0]), 0.3, 1, np.zeros(3))


def test_points_of_a_keyframe_that_is_gone_move_as_their_neighbours_also_across_the_half_turn() -> None:
    recorder = RouteRecorder("hall")
    heading = math.pi - 0.02
    for k in range(30):
        pose = np.array([-0.11 * k, 0.0, heading])
        recorder.add(pose, 0.3, 1 + k // 10, np.zeros(3))
    route = recorder.route(lambda id: KeyframePose(id, np.zeros(3)), {}, 0, "m")
    moved_by = np.array([0.2, -0.1, 0.05])

    def moved(id: int) -> KeyframePose | None:
        return None if id == 2 else KeyframePose(id, moved_by)

    found = route.in_map(moved)
    expected = composed(np.repeat(moved_by[None], 30, 0), route.poses)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=0.01)
    turned = np.remainder(found[:, 2] - expected[:, 2] + math.pi, math.tau) - math.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)


@pytest.mark.parametrize(("beside_m", "joins"), [(0.2, False), (0.3, True)])
def test_a_robot_more_than_25_cm_beside_a_route_drives_to_a_point_ahead(beside_m: float, joins: bool) -> None:
    route = straight((0.0, 3.0, 0.3))
    (path,) = repeated_paths(route, only_keyframe, np.array([1.0, beside_m, 0.0]), loops=1, reverse=False)
    (leg,) = path.legs
    assert (leg.xy[0, 1] > 0.1) == joins and not leg.backwards
    if joins:
        np.testing.assert_allclose(leg.xy[0], (1.0, beside_m))
        assert leg.xy[np.abs(leg.xy[:, 1]) < 1e-3][0, 0] == pytest.approx(1.0 + 2.5 * beside_m, abs=0.16)
    else:
        assert leg.xy[0, 0] == pytest.approx(1.0, abs=0.06)


def test_a_robot_at_the_end_of_a_route_still_gets_a_path() -> None:
    route = straight((0.0, 3.0, 0.3))
    (path,) = repeated_paths(route, only_keyframe, np.array([3.0, 0.0, 0.0]), loops=1, reverse=False)
    assert 0.0 < path.length_m < 0.25 and path.goal[0] == pytest.approx(3.0)


def test_a_route_is_closed_whose_ends_are_within_a_metre() -> None:
    route = straight((0.0, 3.0, 0.3))
    for away_m, is_closed in ((0.9, True), (1.1, False)):
        poses = route.poses.copy()
        poses[-1, :2] = poses[0, :2] + (0.0, away_m)
        assert replace(route, poses=poses).is_closed == is_closed
    assert route.length_m == pytest.approx(3.0) and route.created_s == 7 and route.map_name == "site.omap"


@pytest.mark.parametrize(("heading", "place"), [(0.0, (0.0, 5.0)), (math.pi / 2, (-2.0, 1.0)), (-2.0, (3.0, -4.0))])
def test_a_robot_begins_at_the_part_that_is_near_and_looks_as_it_does_wherever_the_route_lies(
    heading: float, place: tuple[float, float]
) -> None:
    frame = np.array([[*place, heading]])
    there_and_back = [*((0.1 * k, 0.0, 0.0) for k in range(41)), *((4.0 - 0.1 * k, 0.3, math.pi) for k in range(41))]
    recorder = RouteRecorder("hall")
    for pose in there_and_back:
        recorder.add(composed(frame, np.array(pose))[0], 0.3, 1, np.zeros(3))
    route = recorder.route(only_keyframe, {1: 5}, 0, "m")
    for own, left_m in (((1.0, 0.1, 0.2), 7.3), ((1.0, 0.1, math.pi - 0.2), 1.0)):
        robot = composed(frame, np.array(own))[0]
        (path,) = repeated_paths(route, only_keyframe, robot, loops=1, reverse=False)
        assert path.length_m == pytest.approx(left_m, abs=0.35)
        assert abs(math.remainder((path.final_heading_rad or 0.0) - heading - math.pi, math.tau)) < 1e-5
    beside = composed(frame, np.array([1.0, -0.5, 0.0]))[0]
    (path,) = repeated_paths(route, only_keyframe, beside, loops=1, reverse=False)
    joined = [xy for xy in path.legs[0].xy if math.dist(xy, composed(frame, np.array([2.25, 0.0, 0.0]))[0, :2]) < 0.1]
    assert joined and np.hypot(*(path.legs[0].xy - composed(frame, np.array([1.3, 0.0, 0.0]))[0, :2]).T).min() > 0.2


@pytest.mark.parametrize(("away_m", "enters"), [(1.4, True), (1.6, False)])
def test_a_robot_is_near_a_route_within_one_and_a_half_metres(away_m: float, enters: bool) -> None:
    route = straight((0.0, 3.0, 0.3))
    if enters:
        repeated_paths(route, only_keyframe, np.array([1.0, away_m, 0.0]), loops=1, reverse=False)
    else:
        with pytest.raises(OmnidError, match=r"1\.6 m away"):
            repeated_paths(route, only_keyframe, np.array([1.0, away_m, 0.0]), loops=1, reverse=False)


@pytest.mark.parametrize(("length_m", "is_route"), [(0.4, False), (0.62, True)])
def test_half_a_metre_is_the_shortest_route(length_m: float, is_route: bool) -> None:
    if is_route:
        assert straight((0.0, length_m, 0.3)).length_m == pytest.approx(length_m, abs=0.02)
    else:
        with pytest.raises(OmnidError, match=r"expected 0\.5 m and more"):
            straight((0.0, length_m, 0.3))


@pytest.mark.parametrize("turn_deg", [60.0, -60.0])
def test_a_turn_at_the_end_of_a_route_is_its_last_heading(turn_deg: float) -> None:
    recorder = RouteRecorder("hall")
    for x_m in np.arange(0.0, 2.01, 0.05):
        recorder.add(np.array([x_m, 0.0, 0.0]), 0.3, 1, np.zeros(3))
    for share in np.linspace(0.0, 1.0, 31):
        recorder.add(np.array([2.0, 0.0, math.radians(share * turn_deg)]), 0.0, 1, np.zeros(3))
    assert sum(point[0][2] != 0.0 for point in recorder._points) == 5, "the turn is recorded to either side"
    route = recorder.route(only_keyframe, {1: 5}, 0, "m")
    (path,) = repeated_paths(route, only_keyframe, np.zeros(3), loops=1, reverse=False)
    assert path.final_heading_rad == pytest.approx(math.radians(turn_deg), abs=1e-5)
    back = route.reversed()
    np.testing.assert_allclose(back.poses[0, :2], (2.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(back.poses[-1, :2], (0.0, 0.0), atol=1e-6)


def test_two_rounds_are_two_paths() -> None:
    route = straight((0.0, 3.0, 0.3))
    assert len(repeated_paths(route, only_keyframe, np.zeros(3), loops=2, reverse=False)) == 2
