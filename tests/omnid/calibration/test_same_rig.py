"""Is a rig that a drive asks for still the one that was given? Larger changes are those of other cameras."""

from __future__ import annotations

import numpy as np
import pytest

from calib.fit.drive.rig_parameters import RigParameters
from calib.models.camera import Array
from calib.rig import Rig
from omnid.calibration.same_rig import is_nominal, require_same_rig
from omnid.errors import OmnidError
from omnid.simulation.rendering.rigs import make_rig
from tests.omnid.calibration.test_drive import adjusted
from tests.simulation.rigs import nominal_rig, with_real_mirrors

MEASURED = make_rig(misaligned_deg=(0.6, -0.4, 0.5))


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
    with pytest.raises(OmnidError, match=r"turned by 3\.0 deg"):
        require_same_rig(*changed(MEASURED, {"r_x": np.deg2rad(3)}), tracked=False)


def test_nominal_rigs_are_recognised() -> None:
    assert is_nominal(nominal_rig(with_real_mirrors(MEASURED, 1)))
    assert not is_nominal(MEASURED)
