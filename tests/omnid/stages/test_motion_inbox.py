"""Samples of wheels and gyro on their way to the next pair."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.logs.ros_messages import parse_motion
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.stages.motion_inbox import MotionInbox
from omnid.transport.codec import IMU_SCHEMA
from omnid.transport.sensor_codec import gyro_cdr

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def test_samples_of_another_clock_and_too_many_are_dropped_and_counted() -> None:
    inbox = MotionInbox()
    for k in range(5000):
        inbox.add(WheelSample(k, 0.0, 0.0))
    assert inbox.dropped == 5000 - 4096 and len(inbox.take(10**4)) == 4096
    inbox.add(WheelSample(10**12, 0.0, 0.0))
    assert not inbox.take(10**4) and not inbox.take(10**12)
    assert inbox.dropped == 5000 - 4096 + 1


@pytest.mark.parametrize(
    "sample", [WheelSample(5, math.nan, 0.0), WheelSample(5, math.inf, 0.0), GyroSample(5, 0.0, math.nan, 0.0)]
)
def test_a_sample_that_is_not_finite_makes_no_pose_so(sample: MotionSample) -> None:
    inbox = MotionInbox()
    inbox.add(sample)
    kept = WheelSample(6, 0.5, math.nan)  # wheels need not know their turn
    inbox.add(kept)
    (taken,) = inbox.take(10)
    assert taken is kept and inbox.dropped == 1 and inbox.gyro == 0


def test_the_axes_of_a_recorded_gyro_are_not_turned_again() -> None:
    live = MotionInbox(UPSIDE_DOWN)
    live.add(GyroSample(5, 0.1, 0.2, 0.5))
    (sample,) = live.take(10)
    assert isinstance(sample, GyroSample) and (sample.x_radps, sample.y_radps, sample.z_radps) == (0.1, -0.2, -0.5)
    again = MotionInbox(UPSIDE_DOWN)
    recorded = parse_motion(IMU_SCHEMA, memoryview(gyro_cdr(sample, 5)))
    assert recorded is not None
    again.add(recorded)
    assert again.take(10) == (sample,)
