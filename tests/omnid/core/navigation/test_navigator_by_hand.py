"""Single steps of the navigation at exact poses: limits, counted times and ways, what is sent and said."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import ASKED, COMMAND_STALE, IDLE
from omnid.core.navigation.drive import Navigation
from omnid.core.navigation.follower import SETTLED, STAND
from omnid.core.navigation.navigator import STOPS, Navigator
from omnid.core.navigation.path import DrivePath, straight_leg
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import MapPosition, Situation, WheelState
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState

SETTINGS = NavigationSettings(unlocalised_m=1.0, unlocalised_s=4.0, stuck_s=3.0)
LOCALISED = MapPosition(np.zeros(3), MapState.LOCALIZED, 0.02)
UNLOCALISED = MapPosition(np.zeros(3), MapState.ODOMETRY_ONLY, 0.02)
STILL_UNCERTAIN = MapPosition(np.zeros(3), MapState.LOCALIZED, 0.31)


class Steps:
    """A navigator that drives straight on from the origin, 0.1 s from step to step."""

    def __init__(self, frame: NavigationFrame = NavigationFrame.ODOM, lengths_m: tuple[float, ...] = (5.0,)) -> None:
        """lengths_m: of the paths, each from the end of the one before."""
        self.navigator, self.now_s = Navigator(SETTINGS), 0.0
        ends = np.concatenate([[0.0], np.cumsum(lengths_m)])
        paths = [DrivePath((straight_leg((a, 0.0), (b, 0.0)),)) for a, b in itertools.pairwise(ends)]
        self.navigator.start("goal", frame, paths, self.at(0.0, 0.0, 0.0))
        self.step(0.0)

    def at(self, x_m: float, y_m: float, step_s: float = 0.1, **change: object) -> Situation:
        """Return the situation some time after the last one."""
        self.now_s += step_s
        now = Situation(
            round(self.now_s * 1e9),
            np.array([x_m, y_m, 0.0]),
            0.0,
            0.0,
            TrackingState.TRACKING,
            0,
            WheelState(True, False),
            LOCALISED,
        )
        now = now._replace(**change)  # type: ignore[arg-type]
        return now if now.in_map is None else now._replace(in_map=self._stamped(now.in_map, now.stamp_ns))

    def _stamped(self, in_map: MapPosition, stamp_ns: int) -> MapPosition:
        return in_map if in_map.stamp_ns else in_map._replace(stamp_ns=stamp_ns)

    def step(self, x_m: float, y_m: float = 0.0, step_s: float = 0.1, **change: object) -> Navigation:
        return self.navigator.step(self.at(x_m, y_m, step_s, **change))


def test_a_drive_in_the_map_stands_at_once_where_its_place_there_turns_out_to_be_unknown() -> None:
    """As where places contradict odometry; the way by odometry alone is for a robot that was right so far."""
    steps = Steps(NavigationFrame.MAP)
    assert steps.step(0.1, in_map=UNLOCALISED).state is NavigationState.DRIVING
    answer = steps.step(0.2, in_map=UNLOCALISED._replace(sigma_m=1000.0))
    assert answer.state is NavigationState.NOT_LOCALISED and answer.setpoint == STAND
    assert steps.step(0.3).state is NavigationState.DRIVING


def test_a_gap_between_two_poses_counts_as_one_second_and_a_step_back_in_time_as_none() -> None:
    steps = Steps()
    for _ in range(4):
        assert steps.step(0.0, step_s=10.0, state=TrackingState.LOST).state is NavigationState.NOT_LOCALISED
    steps.now_s -= 20.0
    answer = steps.step(0.0, state=TrackingState.LOST)
    assert answer.state is NavigationState.NOT_LOCALISED and answer.setpoint == STAND
    answer = steps.step(0.0, state=TrackingState.LOST)
    assert answer.state is NavigationState.FAILED and "odometry is lost" in answer.reason
    assert answer.setpoint == STAND


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_base_more_than_30_cm_beside_its_corridor_has_left_its_path(side: float) -> None:
    steps = Steps()
    assert steps.step(1.0, side * 1.05).state is NavigationState.DRIVING
    answer = steps.step(1.0, side * 1.15)
    assert answer.state is NavigationState.FAILED and answer.reason.startswith("1.1 m beside the path")
    assert answer.setpoint == STAND


def test_the_way_by_odometry_alone_is_measured_along_it_and_ends_where_the_map_is_known() -> None:
    steps = Steps(NavigationFrame.MAP)
    places = [(0.1 * k, 0.3 * (k % 2)) for k in range(9)]  # 0.32 m each
    driven_m = [steps.step(*place, in_map=UNLOCALISED).state for place in places]
    first = driven_m.index(NavigationState.NOT_LOCALISED)
    assert first == math.ceil(1.0 / math.hypot(0.1, 0.3))
    answer = steps.step(*places[-1], in_map=UNLOCALISED)
    assert answer.reason == "not localised in a map"
    answer = steps.step(*places[-1], in_map=STILL_UNCERTAIN)
    assert answer.state is NavigationState.NOT_LOCALISED and answer.setpoint == STAND
    assert answer.reason == "the pose in the map is uncertain by 0.31 m, more than navigation.map_sigma_m = 0.3"
    assert steps.step(*places[-1], in_map=LOCALISED).state is NavigationState.DRIVING
    assert steps.step(places[-1][0] + 0.9, in_map=UNLOCALISED).state is NavigationState.DRIVING, "it begins again"


@pytest.mark.hazard("H28")
def test_a_pose_in_the_map_counts_once() -> None:
    """The drive ends as without any where no more of them come, as the search for places hangs."""
    steps = Steps(NavigationFrame.MAP)
    old = LOCALISED._replace(stamp_ns=round(steps.now_s * 1e9))
    found = [steps.step(0.3 * k, in_map=old).state for k in range(1, 6)]
    assert found.index(NavigationState.NOT_LOCALISED) + 1 == math.ceil(SETTINGS.unlocalised_m / 0.3)
    assert steps.step(1.5).state is NavigationState.DRIVING


@pytest.mark.hazard("H26")
@pytest.mark.parametrize(
    ("halted_by", "state"), [(ASKED, NavigationState.CANCELLED), ("the bumper is pressed", NavigationState.PAUSED)]
)
def test_a_stop_between_two_poses_ends_a_drive_although_it_is_armed_again(
    halted_by: str, state: NavigationState
) -> None:
    steps = Steps()
    armed = WheelState(True, False, halts=1, halted_by=halted_by)
    assert steps.step(0.1, wheels=armed).state is state
    assert steps.step(0.1, wheels=armed).state is state
    if state is NavigationState.PAUSED:
        assert not steps.navigator.resume(steps.at(0.1, 0.0, wheels=armed))
        assert steps.step(0.1, wheels=armed).state is NavigationState.DRIVING, "a person resumed it"


def test_a_drive_in_odom_needs_no_map() -> None:
    steps = Steps()
    for x_m in np.arange(0.0, 2.0, 0.2):
        assert steps.step(float(x_m), in_map=None).state is NavigationState.DRIVING


def test_nothing_is_sent_before_the_first_request_and_a_stop_after_each_end() -> None:
    navigator, steps = Navigator(SETTINGS), Steps()
    assert not navigator.stopping and navigator.step(steps.at(0.0, 0.0)).setpoint is None
    steps.navigator.cancel("cancelled by a request")
    sent = []
    for _ in range(STOPS + 2):
        sent.append(steps.navigator.stopping)
        assert (steps.step(0.0).setpoint == STAND) == sent[-1]
    assert sent == [True] * STOPS + [False] * 2 and STOPS == 5


def test_a_hold_without_known_obstacles_is_a_block_without_a_way_back() -> None:
    steps = Steps()
    wheels = WheelState(True, False, held_by="the ring is too old")
    for _ in range(60):
        answer = steps.step(1.0, wheels=wheels)
        assert answer.state is NavigationState.BLOCKED and answer.setpoint is not None
        assert answer.left_m == pytest.approx(4.0)


def test_a_paused_drive_sends_a_stop_and_leaves_the_wheels_to_others() -> None:
    steps = Steps()
    assert not steps.navigator.stopping
    steps.navigator.pause("paused by a request")
    assert steps.navigator.stopping
    assert steps.step(0.0) == Navigation(
        None, NavigationState.PAUSED, "paused by a request", *2 * [pytest.approx(math.nan, nan_ok=True)]
    )
    steps.navigator.pause("another reason")
    assert steps.step(0.0).reason == "paused by a request", "the first one stays"
    assert steps.navigator.resume(steps.at(0.0, 0.0)) == ""
    assert not steps.navigator.stopping
    assert steps.step(0.0).state is NavigationState.DRIVING


def test_the_time_without_progress_begins_again_after_a_pause() -> None:
    steps = Steps()
    for _ in range(28):
        assert steps.step(0.0).state is NavigationState.DRIVING
    steps.navigator.pause("paused by a request")
    steps.step(0.0)
    steps.navigator.resume(steps.at(0.0, 0.0))
    for _ in range(27):
        assert steps.step(0.0).state is NavigationState.DRIVING
    assert [steps.step(0.0).state for _ in range(3)][-1] is NavigationState.FAILED


@pytest.mark.parametrize(
    ("by", "turned_rad", "ends"),
    [(0.04, 0.0, True), (0.06, 0.0, False), (0.0, 0.05, True), (0.0, 0.12, False), (0.0, -0.12, False)],
)
def test_progress_is_5_cm_of_the_way_or_5_degrees_of_a_turn(by: float, turned_rad: float, ends: bool) -> None:
    steps = Steps()
    for k in range(40):
        later = steps.at(by if k > 15 else 0.0, 0.0)
        later.pose[2] = turned_rad if k > 15 else 0.0
        answer = steps.navigator.step(later)
    assert (answer.state is NavigationState.FAILED) == ends


def test_a_turn_across_the_half_turn_is_as_small_as_any_other() -> None:
    drive = Steps().navigator.drive
    assert drive is not None
    drive.stands_since_s(np.array([0.0, 0.0, 3.12]), 1.0, 0.1)
    assert drive.stands_since_s(np.array([0.0, 0.0, -3.12]), 1.0, 0.1) == pytest.approx(0.1)
    assert drive.stands_since_s(np.array([0.0, 0.0, 3.12]), 1.0, 0.1) == pytest.approx(0.2)
    assert drive.stands_since_s(np.array([0.0, 0.0, 3.0]), 1.0, 0.1) == 0.0
    assert drive.stands_since_s(np.array([0.0, 0.0, 3.0]), 1.0, 0.1) == pytest.approx(0.1)


def test_the_next_path_begins_where_one_ends_and_the_last_end_is_a_stop() -> None:
    steps = Steps(lengths_m=(1.0, 2.0))
    answers = [steps.step(1.0) for _ in range(SETTLED + 1)]
    begins = next(answer for answer in answers if answer.left_m == pytest.approx(2.0))
    assert begins.state is NavigationState.DRIVING and begins.setpoint == STAND
    assert begins.offset_m == 0.0
    answers = [steps.step(3.0) for _ in range(SETTLED + STOPS + 3)]
    ends = [answer for answer in answers if answer.state is NavigationState.REACHED]
    assert ends[0].left_m == 0.0 and [answer.setpoint for answer in ends] == [STAND] * STOPS + [None] * (
        len(ends) - STOPS
    )


def test_a_goal_that_is_missed_after_all_corrections_is_a_failure_with_the_distance() -> None:
    steps = Steps(lengths_m=(1.0,))
    for correction in range(5):
        for _ in range(SETTLED + 2):
            answer = steps.step(1.05 if correction % 2 == 0 else 0.95)
            if answer.state.is_end:
                assert correction == 3 and answer.state is NavigationState.FAILED
                assert answer.reason == "the goal is missed by 5.0 cm" and answer.setpoint == STAND
                return
    raise AssertionError("no end")


@pytest.mark.parametrize(
    ("reason", "shown"), [("", ""), (IDLE, ""), (COMMAND_STALE, ""), ("the ring is too old", "the ring is too old")]
)
def test_a_rule_that_holds_the_wheels_is_named_and_the_motion_is_still_sent(reason: str, shown: str) -> None:
    steps = Steps()
    wheels = WheelState(True, False, reason=reason)
    steps.step(1.0, wheels=wheels)
    answer = steps.step(1.0, wheels=wheels)
    assert answer.state is NavigationState.DRIVING and answer.reason == shown
    assert answer.setpoint is not None and answer.setpoint.velocity_mps > 0
    for _ in range(40):
        answer = steps.step(1.0, wheels=wheels)
    assert answer.reason == ": ".join(filter(None, ["no progress for 3 s", shown, "look at the robot"]))


def test_a_heading_in_the_map_is_sent_in_odom() -> None:
    steps = Steps(NavigationFrame.MAP)
    assert steps.navigator.drive is not None
    turned = MapPosition(np.array([1.0, 2.0, 0.7]), MapState.LOCALIZED, 0.02)
    now = steps.at(0.0, 0.0, in_map=turned)
    assert steps.navigator.drive.in_odom(Setpoint(0.1, 0.5), now) == Setpoint(0.1, pytest.approx(-0.2))
    assert steps.navigator.drive.in_odom(Setpoint(0.1, -3.0), now) == Setpoint(0.1, pytest.approx(math.tau - 3.7))
    assert steps.navigator.drive.in_odom(Setpoint(0.1, None, 0.3), now) == Setpoint(0.1, None, 0.3)
    ahead = steps.navigator.drive.path_ahead(now, 1.0)
    c, s = math.cos(-0.7), math.sin(-0.7)
    start = np.array([-c * 1.0 + s * 2.0, -s * 1.0 - c * 2.0])
    np.testing.assert_allclose(ahead[0], start, atol=1e-9)
    np.testing.assert_allclose(ahead[-1] - start, np.array([c, s]) * math.dist(ahead[-1], start), atol=1e-9)
