"""Every reason to stop, their order, and numbers that are none."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import pytest

from omnid.core.control import safety_rules as fail_safe
from omnid.core.control.safety_rules import Deadlines, SafetyInputs, stop_reason

DEADLINES = Deadlines(pose_s=0.5, command_s=0.4, tick_s=0.25)
GOOD = SafetyInputs(pose_age_s=0.1, pose_state="tracking", command_age_s=0.1, late_s=0.01)
CAUSES: dict[str, dict[str, object]] = {  # in the order in which they are told
    fail_safe.ENDS: {"ending": True},
    fail_safe.ASKED: {"stop_asked": True},
    fail_safe.FAILED: {"motor_failed": True},
    fail_safe.STOPPED: {"motor_stopped": True},
    fail_safe.OVERLOADED: {"late_s": 0.26},
    fail_safe.POSE_STALE: {"pose_age_s": 0.51},
    fail_safe.POSE_LOST: {"pose_state": "lost"},
    fail_safe.COMMAND_STALE: {"command_age_s": 0.41},
}


def told(**changes: object) -> str:
    return stop_reason(replace(GOOD, **changes), DEADLINES)  # type: ignore[arg-type]


@pytest.mark.parametrize("state", ["tracking", "degraded"])
def test_wheels_may_turn_when_all_is_well(state: str) -> None:
    assert told(pose_state=state) == ""
    assert told(pose_age_s=0.5, command_age_s=0.4, late_s=0.25) == "", "a deadline itself is in time"


@pytest.mark.parametrize("reason", CAUSES)
def test_each_cause_is_a_reason(reason: str) -> None:
    assert told(**CAUSES[reason]) == reason


def test_the_first_of_two_causes_is_told() -> None:
    for first, second in combinations(CAUSES, 2):
        assert told(**CAUSES[first], **CAUSES[second]) == first


def test_all_causes_at_once() -> None:
    everything = {key: value for cause in CAUSES.values() for key, value in cause.items()}
    assert told(**everything) == fail_safe.ENDS


def test_a_robot_without_a_command_is_idle_and_one_without_a_pose_stale() -> None:
    assert told(command_age_s=math.inf) == fail_safe.IDLE
    assert told(pose_age_s=math.inf, pose_state="") == fail_safe.POSE_STALE
    assert told(pose_age_s=math.inf, command_age_s=math.inf) == fail_safe.POSE_STALE


@pytest.mark.parametrize("name", ["pose_age_s", "command_age_s", "late_s"])
def test_what_is_not_a_number_is_a_reason(name: str) -> None:
    assert told(**{name: math.nan}) != ""


@pytest.mark.parametrize("name", ["pose_age_s", "command_age_s"])
def test_what_comes_from_the_future_is_a_reason(name: str) -> None:
    """A camera with wrong stamps must not give a pose that never goes stale."""
    assert told(**{name: -0.001}) == ""
    assert told(**{name: -10.0}) != "" and told(**{name: -math.inf}) != ""
