"""A drive's calibration: other rigs are refused, and lengths follow the baseline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.fit.parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.fit.rig_from_drive import DriveAdjustment, DriveObservations, DriveState
from calib.models.camera import Array
from calib.rig import Rig, RigCovariance
from omnid.calibration.drive import require_same_rig
from omnid.errors import OmnidError
from tests.simulation.rigs import make_rig, nominal_rig, with_real_mirrors

MEASURED = make_rig(misaligned_deg=(0.6, -0.4, 0.5))
MEASURED = replace(MEASURED, covariance=RigCovariance.of_matrix(("r_x",), np.eye(1) * 1e-8))


def adjusted(rig: Rig, sigma: float = 0.01, **changes: float) -> DriveAdjustment:
    """Return an adjustment that changes parameters by the given numbers of their own units."""
    parameters = RigParameters.about(rig, times=(UPPER_DELAY, LINE_TIME))
    named = {name.replace(" ", "_").split("_[")[0]: k for k, name in enumerate(parameters.names)}
    steps = np.zeros(len(parameters.names))
    for name, change in changes.items():
        steps[named[name]] = change / parameters.units[named[name]]
    none = np.zeros(0, np.intp)
    seen = DriveObservations(none, none, none, np.zeros((0, 2)))
    state = DriveState(np.eye(4)[None], np.zeros((0, 3)), np.zeros((1, 6)), np.zeros(1), steps)
    return DriveAdjustment(parameters, state, seen, np.diag((sigma / parameters.units) ** 2), 0.05, np.eye(len(steps)))


def changed(rig: Rig, changes: dict[str, float]) -> tuple[RigParameters, Array]:
    """Return the parameters of a rig and steps that change them."""
    found = adjusted(rig, **changes)
    return found.parameters, found.state.steps


@pytest.mark.parametrize(
    ("rig", "changes", "words"),
    [
        (MEASURED, {"r_x": np.deg2rad(3)}, "turned by 3.0 deg"),
        (MEASURED, {"e_y": np.deg2rad(-4)}, "baseline by 4.0 deg"),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_x": np.deg2rad(5)}, "turned by 5.0 deg"),
        (MEASURED, {"lower_fu": 25.0, "lower_fv": 25.0}, "would change"),
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
