"""The safety rules: every reason to stop, their order, and numbers that are not finite."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import pytest

from omnid.core.control import safety_rules
from omnid.core.control.motion_monitor import CONFLICTS, NOT_COMMANDED, NOT_FOLLOWED, NOT_SEEN
from omnid.core.control.safety_rules import Deadlines, SafetyInputs, stop_reason

DEADLINES = Deadlines(pose_s=0.5, command_s=0.4, tick_s=0.25)
GOOD = SafetyInputs(pose_age_s=0.1, pose_state="tracking", command_age_s=0.1, late_s=0.01)
CAUSES: dict[str, dict[str, object]] = {  # in the order in which they are reported
    safety_rules.ENDS: {"ending": True},
    safety_rules.ASKED: {"stop_asked": True},
    safety_rules.CLIFF: {"contact": safety_rules.CLIFF},
    safety_rules.BUMPER: {"contact": safety_rules.BUMPER},
    safety_rules.AWAITED: {"motor_awaited": True},
    safety_rules.FAILED: {"motor_failed": True},
    safety_rules.STOPPED: {"motor_stopped": True},
    safety_rules.MOTOR_FAULT: {"motor_faulty": True},
    safety_rules.BATTERY_EMPTY: {"battery_empty": True},
    safety_rules.OVERLOADED: {"late_s": 0.26},
    safety_rules.NO_POSE: {"pose_age_s": math.inf},
    safety_rules.POSE_STALE: {"pose_age_s": 0.51},
    safety_rules.POSE_LOST: {"pose_state": "lost"},
    safety_rules.POSE_RESET: {"pose_reset": True},
    safety_rules.POSE_UNSURE: {"pose_unsure": True},
    NOT_FOLLOWED: {"disagreement": NOT_FOLLOWED},
    NOT_SEEN: {"disagreement": NOT_SEEN},
    NOT_COMMANDED: {"disagreement": NOT_COMMANDED},
    **{reason: {"disagreement": reason} for reason in CONFLICTS},
    safety_rules.POSE_JUMPED: {"pose_jumped": True},
    safety_rules.NOT_ARMED: {"armed": False},
    safety_rules.COMMAND_STALE: {"command_age_s": 0.41},
}


def reason_for(**changes: object) -> str:
    return stop_reason(replace(GOOD, **changes), DEADLINES)  # type: ignore[arg-type]


@pytest.mark.parametrize("state", ["tracking", "degraded"])
def test_lets_the_wheels_turn_where_no_rule_applies(state: str) -> None:
    assert reason_for(pose_state=state) == ""
    assert reason_for(pose_age_s=0.5, command_age_s=0.4, late_s=0.25) == "", "a deadline itself is in time"


@pytest.mark.parametrize("reason", CAUSES)
def test_stops_for_each_cause(reason: str) -> None:
    assert reason_for(**CAUSES[reason]) == reason


def test_reports_the_first_of_two_causes() -> None:
    for first, second in combinations(CAUSES, 2):
        if not CAUSES[first].keys() & CAUSES[second].keys():  # one disagreement is reported at a time
            assert reason_for(**CAUSES[first], **CAUSES[second]) == first


def test_reports_the_first_of_all_causes() -> None:
    everything = {key: value for cause in CAUSES.values() for key, value in cause.items()}
    assert reason_for(**everything) == safety_rules.ENDS


def test_reports_what_was_never_there_as_missing_rather_than_stale() -> None:
    assert reason_for(command_age_s=math.inf) == safety_rules.IDLE
    assert reason_for(pose_age_s=math.inf, pose_state="") == safety_rules.NO_POSE
    assert reason_for(pose_age_s=math.inf, command_age_s=math.inf) == safety_rules.NO_POSE


@pytest.mark.parametrize("name", ["pose_age_s", "command_age_s", "late_s"])
def test_stops_where_an_input_is_nan(name: str) -> None:
    assert reason_for(**{name: math.nan}) != ""


@pytest.mark.parametrize("name", ["pose_age_s", "command_age_s"])
def test_stops_where_a_stamp_is_in_the_future(name: str) -> None:
    """A camera with wrong stamps must not give a pose that never goes stale."""
    assert reason_for(**{name: -0.001}) == ""
    assert reason_for(**{name: -10.0}) != "" and reason_for(**{name: -math.inf}) != ""


def test_the_table_has_every_reason_once() -> None:
    reasons = [rule.reason for rule in safety_rules.RULES]
    assert reasons == [*list(CAUSES)[:-1], safety_rules.IDLE, safety_rules.COMMAND_STALE]


def test_only_faults_disarm() -> None:
    """Faults of the robot, not the wishes of its operator."""
    kept = {
        safety_rules.ENDS,
        safety_rules.ASKED,
        safety_rules.POSE_JUMPED,
        safety_rules.NOT_ARMED,
        safety_rules.IDLE,
        safety_rules.COMMAND_STALE,
    }
    assert {rule.reason for rule in safety_rules.RULES if not rule.disarms} == kept
    for reason in CAUSES.keys() - kept:
        everything = replace(GOOD, armed=False, **CAUSES[reason])  # type: ignore[arg-type]
        assert stop_reason(everything, DEADLINES, safety_rules.FAULTS) == reason
