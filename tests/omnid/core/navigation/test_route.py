"""Paths and their legs; requests; routes: tied to keyframes, repeated from anywhere on them, bound to their map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from omnid.core.navigation.navigator import Navigator
from omnid.core.navigation.path import MAX_LENGTH_M, MAX_POINTS, drive_path
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationFrame,
    NavigationRequest,
    NavigationState,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
    begins_nothing,
    navigation_verb,
    route_request,
)
from omnid.core.navigation.route import KeyframePose, Route, RouteRecorder, repeated_paths
from omnid.core.navigation.settings import NavigationSettings
from omnid.errors import OmnidError
from tests.omnid.core.navigation.driven_base import DrivenBase

Array = NDArray[np.float64]
SPACING_M = 1.0  # between keyframes


def way(length_m: float = 12.0) -> Array:
    """Return poses (N, 3) each 2 cm along a way with curves."""
    s = np.arange(0.0, length_m, 0.02)
    heading = 0.6 * np.sin(s / 1.5)
    xy = np.cumsum(0.02 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return np.column_stack([xy, heading])


class Map:
    """Keyframes along a way; `move` does to them what an optimisation does."""

    def __init__(self, poses: Array) -> None:
        self.poses = {k: pose for k, pose in enumerate(poses[:: round(SPACING_M / 0.02)])}
        self.stamps = {k: 1000 + 7 * k for k in self.poses}

    @property
    def keyframes(self) -> dict[int, KeyframePose]:
        return {id: KeyframePose(self.stamps[id], pose) for id, pose in self.poses.items()}

    def nearest(self, pose: Array) -> int:
        return min(self.poses, key=lambda k: math.dist(self.poses[k][:2], pose[:2]))

    def move(self, by: Callable[[Array], Array]) -> None:
        self.poses = {k: by(pose) for k, pose in self.poses.items()}


def taught(poses: Array, places: Map, speed_mps: float = 0.3) -> Route:
    """Return the route of a drive along poses."""
    recorder = RouteRecorder("hall")
    for pose in poses:
        id = places.nearest(pose)
        recorder.add(pose, speed_mps, id, places.poses[id])
    return recorder.route(places.keyframes, 1_700_000_000, "site.omap")


def bent(pose: Array) -> Array:
    """Return a pose of a map that was bent by 8 cm and 2 degrees a metre."""
    return pose + np.array([0.0, 0.005 * pose[0] ** 2, 0.01 * pose[0]])


@pytest.mark.parametrize("last", [0, 3])
def test_a_route_ends_where_the_robot_stood_when_it_was_finished(last: int) -> None:
    poses = way()[: 500 + last]
    standing = np.repeat(poses[-1:], 5, axis=0) + np.array([0.0, 0.0, math.radians(4)])
    route = taught(np.vstack([poses, standing]), places := Map(poses))
    np.testing.assert_allclose(route.poses[-1], standing[-1], atol=1e-6)
    (path,) = repeated_paths(route, places.keyframes, poses[0], loops=1, reverse=False)
    assert len(path.legs) == 1 and not path.legs[0].backwards
    np.testing.assert_allclose(path.goal, poses[-1, :2], atol=1e-6)
    assert path.legs[0].speed.min() == pytest.approx(0.3), "the last step is driven as the others"


def test_a_route_moves_with_the_keyframes_of_its_map() -> None:
    poses = way()
    places = Map(poses)
    route = taught(poses, places)
    np.testing.assert_allclose(route.in_map(places.keyframes), route.poses, atol=2e-6)
    places.move(bent)
    moved = route.in_map(places.keyframes)
    expected = np.array([bent(pose) for pose in route.poses])
    assert np.abs(moved - expected)[:, :2].max() < 0.06, "a metre behind the last keyframe, the map is still bent"
    assert np.abs(moved - route.poses)[-1, 1] > 0.4, "it has moved by much"
    for id in (3, 4, 5):
        del places.poses[id]
    assert np.abs(route.in_map(places.keyframes) - expected)[:, :2].max() < 0.08, "neighbours stand in for what is gone"


@pytest.mark.hazard("H29")
def test_a_keyframe_of_another_map_does_not_count() -> None:
    poses = way()
    places = Map(poses)
    route = taught(poses, places)
    assert route.fits(places.keyframes)
    other = Map(poses)
    other.stamps = {k: stamp + 1 for k, stamp in other.stamps.items()}
    other.move(bent)
    assert not route.fits(other.keyframes)
    np.testing.assert_allclose(route.in_map(other.keyframes), route.poses)
    assert not replace(route, stamps_ns={}).fits(places.keyframes)
    some = Map(poses)
    some.poses = {k: pose for k, pose in some.poses.items() if k % 2}
    assert route.fits(some.keyframes), "an aged map is still the same"


@pytest.mark.parametrize("start", [(0.0, 0.2, 0.0), (4.0, 2.0, 0.3), (0.3, -0.6, 2.0)])
def test_a_route_is_repeated_from_anywhere_on_it(start: tuple[float, float, float]) -> None:
    poses = way()
    places = Map(poses)
    route = taught(poses, places)
    base = DrivenBase(Navigator(NavigationSettings()), 3, start=start)
    paths = repeated_paths(route, places.keyframes, base.pose, loops=1, reverse=False)
    base.navigator.start(NavigationFrame.MAP, paths, base.seen())
    assert base.run(120).state is NavigationState.REACHED
    away_m, turned_rad = base.error(tuple(route.poses[-1]))
    assert away_m < 0.03 and turned_rad < math.radians(1)
    on_way = [np.hypot(*(poses[:, :2] - sample.pose[:2]).T).min() for sample in base.samples]
    joined = next(k for k, away in enumerate(on_way) if away < 0.03)
    assert np.percentile(on_way[joined:], 95) < 0.05


def test_a_route_is_not_driven_once_from_its_end() -> None:
    places = Map(poses := way())
    with pytest.raises(OmnidError, match="the robot is at the end of the route: repeat it in reverse"):
        repeated_paths(taught(poses, places), places.keyframes, poses[-1], loops=1, reverse=False)


def test_a_route_is_driven_there_and_back_and_in_rounds() -> None:
    poses = way(4.0)
    places = Map(poses)
    route = taught(poses, places)
    base = DrivenBase(Navigator(NavigationSettings()), 4)
    paths = repeated_paths(route, places.keyframes, base.pose, loops=2, reverse=False)
    base.navigator.start(NavigationFrame.MAP, paths, base.seen())
    assert base.run(120).state is NavigationState.REACHED
    assert math.dist(base.pose[:2], route.poses[0, :2]) < 0.03, "there and back"
    assert max(sample.pose[0] for sample in base.samples) > 3.0
    a = np.arange(0, math.tau, 0.01)
    scan = np.column_stack([2 * np.sin(a), 2 - 2 * np.cos(a), a])
    closed = taught(scan, Map(scan))
    assert closed.is_closed
    rounds = repeated_paths(closed, Map(scan).keyframes, np.zeros(3), loops=3, reverse=False)
    assert len(rounds) == 3 and rounds[1] is rounds[2] and rounds[1].length_m == pytest.approx(4 * math.pi, abs=0.3)


@pytest.mark.hazard("H29")
def test_a_robot_that_is_not_near_is_refused() -> None:
    route, places = taught(way(), Map(way())), Map(way())
    with pytest.raises(OmnidError, match=r"3\.\d m away from the route: drive it there"):
        repeated_paths(route, places.keyframes, np.array([0.0, 3.5, 0.0]), loops=1, reverse=False)


def test_a_piece_that_was_driven_backwards_is_repeated_so() -> None:
    ahead = np.column_stack([np.arange(0, 2, 0.02), np.zeros(100), np.zeros(100)])
    recorder, places = RouteRecorder("dock"), Map(ahead)
    for pose, speed in [*((pose, 0.3) for pose in ahead), *((pose, -0.2) for pose in ahead[:40:-1])]:
        recorder.add(pose, speed, 0, places.poses[0])
    route = recorder.route(places.keyframes, 0, "m")
    (path,) = repeated_paths(route, places.keyframes, np.zeros(3), loops=1, reverse=False)
    assert [leg.backwards for leg in path.legs] == [False, True]


@pytest.mark.parametrize(("turn_deg", "legs"), [(35.0, 1), (-35.0, 1), (45.0, 2), (-45.0, 2), (180.0, 2)])
def test_a_leg_ends_where_the_path_turns_by_more_than_40_degrees(turn_deg: float, legs: int) -> None:
    turn = math.radians(turn_deg)
    for begin in (0.0, 3.0, -2.5):
        first = np.array([math.cos(begin), math.sin(begin)])
        then = np.array([math.cos(begin + turn), math.sin(begin + turn)])
        path = drive_path([(0.0, 0.0), first, first + then])
        assert len(path.legs) == legs and path.length_m == pytest.approx(2.0, abs=0.05)
        if legs == 2:
            np.testing.assert_allclose(path.legs[0].xy[-1], first)
            np.testing.assert_allclose(path.legs[1].xy[0], first)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((MAX_POINTS + 1, 2)), f"a path of {MAX_POINTS + 1} points"),
        ([(1.0, 2.0), (1.0, 2.0)], "a path"),
        ([(0.0, 0.0), (math.inf, 1.0)], "not finite"),
        ([(0.0, 0.0), (MAX_LENGTH_M + 1.0, 0.0)], "longer than 5000 m"),
        ([(0.0, 0.0), (0.0, 3000.0), (0.0, 0.0)], "longer than 5000 m"),
    ],
)
def test_other_points_are_no_path_and_the_message_says_why(points: ArrayLike, words: str) -> None:
    with pytest.raises(OmnidError, match=words):
        drive_path(points)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("teach hall", RouteRequest(RouteAction.TEACH, "hall")),
        ("teach hall replace", RouteRequest(RouteAction.TEACH, "hall", replace=True)),
        ("stop", RouteRequest(RouteAction.STOP)),
        ("repeat hall", RouteRequest(RouteAction.REPEAT, "hall")),
        ("  repeat  hall-2 reverse  loops=12 ", RouteRequest(RouteAction.REPEAT, "hall-2", True, 12)),
        ("repeat hall loops=2", RouteRequest(RouteAction.REPEAT, "hall", False, 2)),
    ],
)
def test_texts_are_parsed_as_requests_about_routes(text: str, expected: RouteRequest) -> None:
    assert route_request(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "teach",
        "repeat a from=start",
        "repeat a loops=2 loops=3",
        "teach ../etc",
        "repeat a loops=0",
        "finish now",
        "teach " + "a" * 65,
        "repeat a" + " " * 500,
        "repeat a\0",
    ],
)
def test_other_texts_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(OmnidError) as error:
        route_request(text)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300 and str(error.value).isascii()


@pytest.mark.parametrize("verb", list(NavigationVerb))
def test_texts_are_parsed_as_verbs(verb: NavigationVerb) -> None:
    assert navigation_verb(f" {verb}\n") is verb
    with pytest.raises(OmnidError):
        navigation_verb(verb.upper())


@pytest.mark.parametrize(
    ("request_", "ends"),
    [
        (NavigationVerb.CANCEL, True),
        (NavigationVerb.PAUSE, True),
        (NavigationVerb.RESUME, False),
        (GoalRequest(NavigationFrame.ODOM, 1.0, 0.0), False),
        (PathRequest(NavigationFrame.ODOM, np.zeros((2, 2))), False),
        *((RouteRequest(action, "hall"), action in (RouteAction.FINISH, RouteAction.STOP)) for action in RouteAction),
    ],
)
def test_only_cancel_pause_and_the_end_of_a_route_are_ends(request_: NavigationRequest, ends: bool) -> None:
    assert begins_nothing(request_) == ends
