"""Sources of commands: priorities, ownership of a source by one sender, and their end."""

from __future__ import annotations

import pytest

from omnid.core.control.command_sources import (
    LOWER_PRIORITY,
    OPERATOR,
    OTHER_SENDER,
    PLANNER,
    UNKNOWN_SOURCE,
    CommandSelector,
    SourceSettings,
    TimedSetpoint,
)
from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError

HOLD_S = 0.5


@pytest.fixture
def selector() -> CommandSelector:
    return CommandSelector(SourceSettings(("joystick", OPERATOR, PLANNER), HOLD_S))


def offer(selector: CommandSelector, at_s: float, source: str = OPERATOR, sender: str = "a") -> bool:
    """Offer a command; return whether it is the current one now."""
    command = TimedSetpoint(10**12 + round(at_s * 1e9), Setpoint(0.1), source, sender)
    selector.offer(command)
    return selector.current == command


@pytest.mark.hazard("H07")
def test_a_higher_source_takes_over_at_once_and_keeps_the_lower_one_out(selector: CommandSelector) -> None:
    assert offer(selector, 0.0, PLANNER) and offer(selector, 0.1, OPERATOR)
    assert not any(offer(selector, 0.1 + 0.1 * k, PLANNER) for k in range(6))
    assert offer(selector, 0.61, PLANNER), "the operator has been silent for longer than hold_s"
    assert selector.refused == {LOWER_PRIORITY: 6} and selector.conflict == ""


def test_the_replaced_source_must_send_again(selector: CommandSelector) -> None:
    offer(selector, 0.0, PLANNER)
    offer(selector, 0.01, "joystick")
    assert selector.current is not None and selector.current.source == "joystick"


@pytest.mark.hazard("H07")
def test_the_first_sender_of_a_source_keeps_it_until_it_is_silent(selector: CommandSelector) -> None:
    assert offer(selector, 0.0, sender="a")
    for k in range(10):
        assert not offer(selector, 0.1 * k + 0.05, sender="b") and offer(selector, 0.1 * k + 0.1, sender="a")
    assert offer(selector, 1.51, sender="b"), "a has been silent since 1.0 s"
    assert not offer(selector, 1.6, sender="a")
    assert selector.refused == {OTHER_SENDER: 11}


def test_two_senders_are_named_once_and_again_when_they_change(selector: CommandSelector) -> None:
    found = set()
    for k in range(10):
        offer(selector, 0.1 * k, sender="a")
        offer(selector, 0.1 * k + 0.05, sender="" if k > 6 else "b")
        found.add(selector.conflict)
    assert len(found) == 2
    assert "two programs send commands as 'operator': a drives, those of b are refused" in found


def test_programs_without_an_identity_count_as_one(selector: CommandSelector) -> None:
    assert offer(selector, 0.0, sender="") and offer(selector, 0.1, sender="") and selector.refused == {}


def test_refuses_unknown_sources_and_keeps_the_newest_of_reordered_commands(selector: CommandSelector) -> None:
    assert not offer(selector, 0.0, "autopilot") and selector.refused == {UNKNOWN_SOURCE: 1}
    assert offer(selector, 1.0) and not offer(selector, 0.9)
    assert selector.current is not None and selector.current.arrival_ns == 10**12 + 10**9


@pytest.mark.parametrize("names", [(), ("a",) * 2, tuple("abcdefghi"), ("A",), ("a/b",), ("stop",), ("",), ("x" * 33,)])
def test_refuses_names_that_are_no_topics(names: tuple[str, ...]) -> None:
    with pytest.raises(OmnidError, match=r"controller\.sources\.names"):
        SourceSettings(names)
    assert SourceSettings(("a",)).names == ("a",) and len(SourceSettings(tuple("abcdefgh")).names) == 8
