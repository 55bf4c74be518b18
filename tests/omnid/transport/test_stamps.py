"""Stamps of commands: fresh where clocks are synchronised, rising where they are others."""

from __future__ import annotations

import time

import pytest

from omnid.transport.stamps import EARLY, NOT_RISING, TOO_OLD, UNSTAMPED, USED_BEFORE, RefusedStamp, StampRule

SECOND_NS = 10**9


def refusal(rule: StampRule, stamp_ns: int, topic: str = "cmd/twist") -> str:
    """Return the reason for which a stamp is refused, empty where it is accepted."""
    try:
        rule.check_arm(stamp_ns) if topic == "cmd/arm" else rule.check(topic, stamp_ns)
    except RefusedStamp as error:
        return str(error)
    return ""


@pytest.mark.parametrize("topic", ["cmd/twist", "cmd/arm"])
@pytest.mark.parametrize(("later_s", "reason"), [(0.0, ""), (-30.0, ""), (30.0, ""), (-90.0, TOO_OLD), (90.0, EARLY)])
def test_synchronised_clocks_differ_by_the_longest_age(topic: str, later_s: float, reason: str) -> None:
    rule = StampRule(60.0)
    assert refusal(rule, time.time_ns() + round(later_s * SECOND_NS), topic) == reason
    assert refusal(rule, 0, topic) == UNSTAMPED


def test_stamps_of_other_clocks_rise_in_each_topic() -> None:
    rule = StampRule(60.0, synchronised=False)
    assert [refusal(rule, stamp) for stamp in (5, 6, 6, 3, 7)] == ["", "", NOT_RISING, NOT_RISING, ""]
    assert refusal(rule, 1, "cmd/heading") == "" and refusal(rule, 0) == UNSTAMPED


def test_an_accepted_request_to_arm_lets_stamps_begin_again_and_counts_once() -> None:
    rule = StampRule(60.0, synchronised=False)
    assert refusal(rule, 500) == "" and refusal(rule, 9, "cmd/arm") == ""
    assert refusal(rule, 4) == NOT_RISING, "not accepted yet"
    rule.accept_arm(9)
    assert refusal(rule, 4) == "" and refusal(rule, 9, "cmd/arm") == USED_BEFORE and refusal(rule, 8, "cmd/arm") == ""
