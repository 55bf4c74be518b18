"""The state of a robot as its messages show it, and the inbox in which they wait."""

from __future__ import annotations

from omnid.monitor.robot_state import Inbox, ReceivedMessage
from omnid.transport.decode import Diagnostics
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import WHEELS
from tests.omnid.monitor.test_follow import received


def test_counts_missed_poses_but_not_those_of_a_restart() -> None:
    assert received(1, 2, 5, 6).missed == 2
    assert received(5, 6, 1, 2).missed == 0
    broken = received(1)
    assert broken.process(ReceivedMessage(1, "odom", b"nonsense", b"")) is None and broken.broken == 1


def test_the_statuses_of_a_daemon_that_has_ended_are_forgotten_once() -> None:
    state = received(1)
    status = Diagnostics(1, (DiagnosticStatus(WHEELS, 0, "armed", {}),))
    state.add_diagnostics(status)
    state.set_alive(True)
    assert not state.forget_ended() and state.statuses
    for alive in (False, True):  # it is back before the next message is processed
        state.set_alive(alive)
    assert state.forget_ended() and not state.statuses
    state.add_diagnostics(status)
    assert not state.forget_ended() and state.statuses
    state.set_alive(False)
    assert state.forget_ended() and not state.forget_ended()
    assert (state.ends, state.restarts, received(5, 6, 1, 2, 2).restarts) == (2, 0, 1)


def test_the_inbox_drops_the_oldest_when_full() -> None:
    inbox = Inbox()
    for number in range(2010):
        inbox.put(str(number), b"", b"")
    first = inbox.get(0.0)
    assert inbox.dropped == 10 and first is not None and first.topic == "10"
