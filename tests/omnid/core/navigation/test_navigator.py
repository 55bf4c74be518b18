"""Navigation in a closed loop: goals and paths; every end is a stop, each stop has a reason, a person lifts a fault."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from omnid.core.control.arming import OPERATOR, ArmRequest, TimedSetpoint
from omnid.core.control.control_law import ControllerState
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.navigator import STOPS, WAITS, Navigation, Navigator
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame, NavigationState
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import MapPosition, Situation, require_drivable
from omnid.errors import OmnidError
from omnid.tracking_state import MapState, TrackingState
from tests.omnid.core.navigation.driven_base import ARMED, DrivenBase

SETTINGS = NavigationSettings(unlocalised_m=1.0, unlocalised_s=4.0, stuck_s=3.0)


def driving(
    frame: NavigationFrame = NavigationFrame.ODOM, seed: int = 1, settings: NavigationSettings = SETTINGS
) -> DrivenBase:
    """Return a base that is on its way to a goal 5 m ahead."""
    base = DrivenBase(Navigator(settings), seed)
    path = DrivePath((straight_leg((0.0, 0.0), (5.0, 0.0)),), 0.0)
    base.navigator.start(frame, [path], base.seen())
    base.run(20, lambda answer: answer.left_m < 4.0, rest_s=0)
    assert base.v > 0.3 and base.navigator.state is NavigationState.DRIVING
    return base


def rest(base: DrivenBase, seconds: float) -> Navigation:
    """Let the time pass; return the last answer."""
    for _ in range(round(seconds / 0.02)):
        base.tick()
    return base.samples[-1].navigation


def assert_at_rest(base: DrivenBase) -> None:
    assert abs(base.v) < 0.01 and abs(base.w) < 0.02


@pytest.mark.hazard("H24")
def test_cancel_stops_at_once_and_then_gives_the_wheels_free() -> None:
    base = driving()
    base.navigator.cancel("by a request")
    answers = [base.samples[-1].navigation]
    while len(answers) <= STOPS + 1:
        answer = base.tick()
        answers += [answer] if answer else []
    assert all(a.setpoint is not None and a.setpoint.velocity_mps == 0.0 for a in answers[1 : STOPS + 1])
    assert answers[-1].setpoint is None and answers[-1].state is NavigationState.CANCELLED
    rest(base, 1.0)
    assert_at_rest(base)
    assert base.pose[0] < 1.6


def test_a_pause_stops_the_base_and_a_resume_drives_on() -> None:
    base = driving()
    base.navigator.pause("paused by a request")
    assert rest(base, 2.0).state is NavigationState.PAUSED
    assert_at_rest(base)
    base.navigator.resume(base.seen())
    assert base.run(60).state is NavigationState.REACHED


@pytest.mark.hazard("H26")
def test_a_stop_ends_the_drive_and_arming_does_not_start_it_again() -> None:
    base = driving()
    base.law.arming.stop(round(base.t_s * 1e9))
    assert rest(base, 1.0).state is NavigationState.CANCELLED
    base.law.take(ArmRequest(round(base.t_s * 1e9)))
    x = base.pose[0]
    rest(base, 2.0)
    assert base.pose[0] == pytest.approx(x, abs=1e-3)


@pytest.mark.hazard("H26")
def test_a_fault_pauses_the_drive_until_a_person_arms_and_resumes() -> None:
    base = driving()
    base.law.arming._automatic = False  # as with controller.arming = "manual"
    base.state = TrackingState.LOST
    rest(base, 0.5)
    base.state = TrackingState.TRACKING
    answer = rest(base, 1.0)
    assert answer.state is NavigationState.PAUSED
    assert "`omnid goto --resume`" in answer.reason and "the pose is lost" in answer.reason
    assert_at_rest(base)
    with pytest.raises(OmnidError, match="not armed"):
        base.navigator.resume(base.seen())
    base.law.take(ArmRequest(round(base.t_s * 1e9)))
    x = base.pose[0]
    assert rest(base, 1.0).state is NavigationState.PAUSED
    assert base.pose[0] == pytest.approx(x, abs=1e-3), "arming alone does not move it"
    base.navigator.resume(base.seen())
    assert base.run(60).state is NavigationState.REACHED


@pytest.mark.hazard("H28")
def test_a_drive_waits_where_the_map_is_lost_for_too_far() -> None:
    base = driving(NavigationFrame.MAP)
    base.localised, x = False, base.pose[0]
    base.run(20, lambda answer: answer.state is NavigationState.NOT_LOCALISED)
    assert base.pose[0] - x == pytest.approx(SETTINGS.unlocalised_m, abs=0.25)
    assert_at_rest(base)
    base.localised = True
    assert base.run(60).state is NavigationState.REACHED


@pytest.mark.hazard("H28")
def test_a_drive_fails_where_the_map_is_not_found_again() -> None:
    base = driving(NavigationFrame.MAP)
    base.localised = False
    answer = base.run(60)
    assert answer.state is NavigationState.FAILED and "not localised for 4 s" in answer.reason
    assert_at_rest(base)


@pytest.mark.hazard("H28")
def test_a_new_odom_ends_a_drive_in_it_and_a_drive_in_the_map_waits_for_its_place() -> None:
    base = driving()
    base.resets = 1
    answer = base.run(2)
    assert answer.state is NavigationState.FAILED and "begun again" in answer.reason
    base = driving(NavigationFrame.MAP)
    base.resets, base.localised = 1, False
    assert rest(base, 1.0).state is NavigationState.NOT_LOCALISED
    assert_at_rest(base)


@pytest.mark.hazard("H31")
def test_a_drive_fails_without_progress() -> None:
    base = driving()
    base.slip = 0.0
    answer = base.run(20)
    assert answer.state is NavigationState.FAILED and answer.reason == "no progress for 3 s: look at the robot"


@pytest.mark.hazard("H30")
def test_a_drive_waits_for_the_operator_and_fails_far_from_its_path() -> None:
    base = driving()
    for _ in range(100):
        base.law.take(TimedSetpoint(round(base.t_s * 1e9), Setpoint(0.0), OPERATOR))
        base.tick()
    answer = base.samples[-1].navigation
    assert answer.state is NavigationState.PAUSED and answer.reason.startswith("operator drives: it goes on when")
    assert_at_rest(base)
    base.pose = base.pose + np.array([0.0, 2.0, 0.0])
    assert "beside the path" in base.run(10).reason


def test_a_hold_of_the_collision_monitor_is_a_block_with_its_reason() -> None:
    base = driving()
    wheels = replace(base.wheels, obstacle="an obstacle is in the way", blocked=True)
    answer = base.navigator.step(base.seen()._replace(wheels=wheels))
    assert answer.state is NavigationState.BLOCKED and answer.reason == f"an obstacle is in the way: {WAITS}"
    assert answer.setpoint is not None and answer.setpoint.velocity_mps > 0, "the monitor lets go by itself"


@pytest.mark.hazard("H28")
def test_a_pose_in_the_map_counts_once() -> None:
    """The drive ends as without any where no more of them come, as the search for places hangs."""
    base = driving(NavigationFrame.MAP)
    old, begin_m = base.seen().in_map, base.pose[0]
    while base.navigator.step(base.seen()._replace(in_map=old)).state is NavigationState.DRIVING:
        base.pose, base.t_s = base.pose + np.array([0.1, 0.0, 0.0]), base.t_s + 0.1
    assert base.navigator.state is NavigationState.NOT_LOCALISED
    assert base.pose[0] - begin_m == pytest.approx(SETTINGS.unlocalised_m, abs=0.15)
    assert base.navigator.step(base.seen()).state is NavigationState.DRIVING


@pytest.mark.hazard("H26")
@pytest.mark.parametrize(
    ("stopped_by", "state"), [(ASKED, NavigationState.CANCELLED), ("the bumper is pressed", NavigationState.PAUSED)]
)
def test_a_stop_between_two_poses_ends_a_drive_although_it_is_armed_again(
    stopped_by: str, state: NavigationState
) -> None:
    base = driving()
    armed = replace(ARMED, stop_count=1, stopped_by=stopped_by)
    for _ in range(2):
        assert base.navigator.step(base.seen()._replace(wheels=armed)).state is state
    if state is NavigationState.PAUSED:
        base.navigator.resume(base.seen()._replace(wheels=armed))
        now = base.seen()._replace(wheels=armed)
        assert base.navigator.step(now).state is NavigationState.DRIVING, "a person resumed it"


@pytest.mark.parametrize(
    ("change", "frame", "words"),
    [
        ({"wheels": ControllerState(needs_request=True)}, "odom", "omnid arm"),
        ({"state": TrackingState.LOST}, "odom", "odometry is lost"),
        ({"in_map": None}, "map", "not localised"),
        ({"in_map": MapPosition(np.zeros(3), MapState.ODOMETRY_ONLY, 0.01)}, "map", "not localised"),
        ({"in_map": MapPosition(np.zeros(3), MapState.LOCALIZED, 0.5)}, "map", "uncertain by 0.50 m"),
        ({"in_map": MapPosition(np.zeros(3), MapState.LOCALIZED, math.nan)}, "map", "uncertain"),
        ({"in_map": None}, "odom", ""),
    ],
)
def test_refusals_name_the_remedy(change: dict[str, object], frame: str, words: str) -> None:
    now = Situation(
        0,
        np.zeros(3),
        0.0,
        0.0,
        TrackingState.TRACKING,
        0,
        ARMED,
        MapPosition(np.zeros(3), MapState.LOCALIZED, 0.02),
    )._replace(**change)  # type: ignore[arg-type]
    if not words:
        require_drivable(now, NavigationFrame(frame), 0.3)
        return
    with pytest.raises(OmnidError, match=words) as error:
        require_drivable(now, NavigationFrame(frame), 0.3)
    assert "\n" not in str(error.value)


GOAL_M, GOAL_RAD = 0.03, math.radians(1)


def to_goal(base: DrivenBase, x: float, y: float, heading: float | None) -> None:
    """Begin to drive to a goal in odom."""
    path = DrivePath((straight_leg(base.pose, (x, y)),), heading)
    base.navigator.start(NavigationFrame.ODOM, [path], base.seen())


@pytest.mark.parametrize(
    ("goal", "first"),
    [
        ((10.0, 0.0, 0.0), 0),
        ((3.0, 2.0, math.pi / 2), 4),
        ((-2.0, -1.0, 0.3), 8),
        ((0.0, 0.0, math.pi), 12),
        ((0.06, 0.03, 0.0), 14),
    ],
)
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 4), marks=pytest.mark.slow)])
def test_the_base_reaches_goals_within_3_cm(goal: tuple[float, float, float], first: int, seeds: range) -> None:
    for seed in (first + more for more in seeds):
        base = DrivenBase(Navigator(NavigationSettings()), seed)
        to_goal(base, *goal)
        assert base.run(90).state is NavigationState.REACHED
        away_m, turned_rad = base.error(goal)
        assert away_m < GOAL_M and turned_rad < GOAL_RAD, seed
        assert abs(base.v) < 0.01 and abs(base.w) < 0.01, "every end is a stop"


def test_the_base_drives_a_square_of_10_m_and_turns_at_its_corners() -> None:
    corners = [(0.0, 0.0), (2.5, 0.0), (2.5, 2.5), (0.0, 2.5), (0.0, 0.0)]
    path = drive_path(corners, 0.0)
    assert len(path.legs) == 4
    for seed in range(3):
        base = DrivenBase(Navigator(NavigationSettings()), seed)
        base.navigator.start(NavigationFrame.ODOM, [path], base.seen())
        assert base.run(120).state is NavigationState.REACHED
        away_m, turned_rad = base.error((0.0, 0.0, 0.0))
        assert away_m < GOAL_M and turned_rad < GOAL_RAD
        xy = np.array([sample.pose[:2] for sample in base.samples])
        for corner in corners:
            assert np.hypot(*(xy - corner).T).min() < 0.06
        beside = np.minimum.reduce([np.abs(xy[:, 0]), np.abs(xy[:, 0] - 2.5), np.abs(xy[:, 1]), np.abs(xy[:, 1] - 2.5)])
        assert np.percentile(beside, 95) < 0.05


def test_the_base_follows_curves_within_5_cm_and_slows_down_in_them() -> None:
    s = np.linspace(0, 4 * math.pi, 200)
    points = np.column_stack([s, np.sin(1.5 * s)])
    base = DrivenBase(Navigator(NavigationSettings()), 1)
    base.navigator.start(NavigationFrame.ODOM, [drive_path(points)], base.seen())
    assert base.run(120).state is NavigationState.REACHED
    t = np.linspace(0, 4 * math.pi, 4000)
    fine = np.column_stack([t, np.sin(1.5 * t)])
    away = [np.hypot(*(fine - sample.pose[:2]).T).min() for sample in base.samples]
    assert np.percentile(away, 95) < 0.05
    speeds = [sample.speed_mps for sample in base.samples if 1 < sample.pose[0] < 11]
    assert max(speeds) > 0.3 and min(speeds) < 0.8 * max(speeds)


def test_the_base_drives_backwards_where_the_path_was_driven_so() -> None:
    points = [(0.0, 0.0), (2.0, 0.0), (1.0, 0.0)]
    path = drive_path(points, 0.0, speeds=[1.0, 1.0, -1.0])
    assert [leg.backwards for leg in path.legs] == [False, True]
    base = DrivenBase(Navigator(NavigationSettings()), 2)
    base.navigator.start(NavigationFrame.ODOM, [path], base.seen())
    assert base.run(60).state is NavigationState.REACHED
    assert min(sample.speed_mps for sample in base.samples) < -0.2
    assert max(abs(float(sample.pose[2])) for sample in base.samples) < 0.3, "it does not turn round"


def test_the_base_follows_the_map_when_it_is_corrected() -> None:
    base = DrivenBase(Navigator(NavigationSettings()), 6, T_map_odom=(1.0, -0.5, 0.4))
    pose = base.seen().pose_in(NavigationFrame.MAP)
    goal = pose + np.array([3.0, 1.0, 0.2])
    base.navigator.start(NavigationFrame.MAP, [DrivePath((straight_leg(pose, goal),), goal[2])], base.seen())
    base.run(60, lambda answer: answer.left_m < 1.5, rest_s=0)
    base.T_map_odom = base.T_map_odom + np.array([0.1, 0.05, 0.02])
    assert base.run(60).state is NavigationState.REACHED
    found = base.seen().pose_in(NavigationFrame.MAP)
    assert math.dist(found[:2], goal[:2]) < 0.04 and abs(found[2] - goal[2]) < 0.03
