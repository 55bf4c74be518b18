"""The state of a robot as its messages show it, and the inbox in which they wait."""

from __future__ import annotations

from omnid.monitor.robot_state import Inbox, ReceivedMessage
from tests.omnid.monitor.test_follow import received


def test_counts_missed_poses_but_not_those_of_a_restart() -> None:
    assert received(1, 2, 5, 6).missed == 2
    assert received(5, 6, 1, 2).missed == 0
    broken = received(1)
    assert broken.process(ReceivedMessage(1, "odom", b"nonsense", b"")) is None and broken.broken == 1


def test_the_inbox_drops_the_oldest_when_full() -> None:
    inbox = Inbox()
    for number in range(2010):
        inbox.put(str(number), b"", b"")
    first = inbox.get(0.0)
    assert inbox.dropped == 10 and first is not None and first.topic == "10"
