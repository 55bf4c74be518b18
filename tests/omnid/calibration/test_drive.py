"""Judgement of a drive's calibration: other rigs are refused, times of exposure count where they are significant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.fit.drive.adjustment import DriveAdjustment
from calib.fit.drive.observations import DriveObservations, DriveState, KeyframeMotion
from calib.fit.drive.rig_parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.models.camera import Array
from calib.rig import Rig, ShutterTimes
from omnid.calibration.drive import significant_times
from omnid.calibration.same_rig import is_nominal, require_same_rig
from omnid.errors import OmnidError
from omnid.simulation.rendering.rigs import make_rig
from tests.simulation.rigs import nominal_rig, with_real_mirrors

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


def changed(rig: Rig, changes: dict[str, float]) -> tuple[RigParameters, Array]:
    """Return the parameters of a rig and steps that change them."""
    found = adjusted(rig, **changes)
    return found.parameters, found.state.steps


@pytest.mark.parametrize(
    ("rig", "changes", "words"),
    [
        (MEASURED, {"r_x": np.deg2rad(3)}, "3.0 deg turned"),
        (MEASURED, {"e_y": np.deg2rad(-4)}, "4.0 deg aside"),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_x": np.deg2rad(5)}, "5.0 deg turned"),
        (MEASURED, {"lower_fu": 25.0, "lower_fv": 25.0}, "would change"),
        (MEASURED, {"upper_xi": -0.2}, "upper xi would change from 1 to 0.8"),
        (MEASURED, {"lower_pu": 20.0}, "lower pu would change"),
    ],
)
def test_another_rig_is_refused(rig: Rig, changes: dict[str, float], words: str) -> None:
    with pytest.raises(OmnidError, match=words) as raised:
        require_same_rig(*changed(rig, changes))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("rig", "changes"),
    [
        (MEASURED, {"r_x": np.deg2rad(1.5), "e_y": np.deg2rad(1), "lower_fu": 5.0, "upper_xi": 0.02, "upper_pv": 5.0}),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_y": np.deg2rad(-4)}),
    ],
)
def test_the_same_rig_is_accepted(rig: Rig, changes: dict[str, float]) -> None:
    require_same_rig(*changed(rig, changes))


def test_a_camera_aside_is_judged_after_tracking_only() -> None:
    """A late exposure of the upper camera looks the same before the motion is known."""
    require_same_rig(*changed(MEASURED, {"e_y": np.deg2rad(4)}), tracked=False)
    with pytest.raises(OmnidError, match=r"3\.0 deg turned"):
        require_same_rig(*changed(MEASURED, {"r_x": np.deg2rad(3)}), tracked=False)


def test_nominal_rigs_are_recognised() -> None:
    assert is_nominal(nominal_rig(with_real_mirrors(MEASURED, 1)))
    assert not is_nominal(MEASURED)


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
