"""Samples of wheels and gyro on their way to the next pair."""

from __future__ import annotations

from drivers.motion import WheelSample
from omnid.stages.motion_inbox import MotionInbox


def test_samples_of_another_clock_and_too_many_are_dropped_and_counted() -> None:
    inbox = MotionInbox()
    for k in range(5000):
        inbox.add(WheelSample(k, 0.0, 0.0))
    assert inbox.dropped == 5000 - 4096 and len(inbox.take(10**4)) == 4096
    inbox.add(WheelSample(10**12, 0.0, 0.0))
    assert not inbox.take(10**4) and not inbox.take(10**12)
    assert inbox.dropped == 5000 - 4096 + 1
