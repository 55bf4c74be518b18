"""Judgement of a drive's calibration: other rigs are refused, times of exposure count where they are significant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.fit.drive.adjustment import DriveAdjustment
from calib.fit.drive.observations import DriveObservations, DriveState, KeyframeMotion
from calib.fit.drive.rig_parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.rig import Rig, ShutterTimes
from omnid.calibration.drive import significant_times
from omnid.simulation.rendering.rigs import make_rig

MEASURED = make_rig(misaligned_deg=(0.6, -0.4, 0.5))


def adjusted(rig: Rig, sigma: float = 0.01, **changes: float) -> DriveAdjustment:
    """Return an adjustment that changes parameters by the given numbers of their own units."""
    parameters = RigParameters.about(rig, times=(UPPER_DELAY, LINE_TIME))
    named = {name.replace(" ", "_").split("_[")[0]: k for k, name in enumerate(parameters.names)}
    steps = np.zeros(len(parameters.names))
    for name, change in changes.items():
        steps[named[name]] = change / parameters.units[named[name]]
    none = np.zeros(0, np.intp)
    seen = DriveObservations(none, none, none, np.zeros((0, 2)))
    state = DriveState(np.eye(4)[None], np.zeros((0, 3)), steps, KeyframeMotion.still(1))
    return DriveAdjustment(parameters, state, seen, np.diag((sigma / parameters.units) ** 2), 0.05, np.eye(len(steps)))


def test_times_of_exposure_are_those_of_the_file_and_the_change() -> None:
    parameters = RigParameters.about(replace(MEASURED, times=ShutterTimes(4e-3, 20e-6)), times=(UPPER_DELAY,))
    steps = np.zeros(len(parameters.names))
    steps[-1] = 2.0 / parameters.units[-1]
    assert parameters.at(steps).times == parameters.times_at(steps)
    assert parameters.times_at(steps).upper_delay_s == pytest.approx(6e-3)
    assert parameters.times_at(steps).line_time_s == 20e-6
    assert parameters.values[-1] == pytest.approx(4.0)


def test_times_of_exposure_count_if_they_are_significant() -> None:
    assert significant_times(adjusted(MEASURED)) == ()
    assert significant_times(adjusted(MEASURED, upper_delay=3.0, line_time=0.5)) == (UPPER_DELAY,)
    assert significant_times(adjusted(MEASURED, upper_delay=3.0, line_time=-26.0)) == (UPPER_DELAY, LINE_TIME)
    assert significant_times(adjusted(MEASURED, sigma=1.0, upper_delay=3.0)) == ()
