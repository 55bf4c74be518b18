"""Is a rig that a drive asks for still the one that was given? Larger changes are those of other cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive.rig_parameters import TRANSFORM_NAMES, RigParameters
from calib.fit.drive.rig_prior import nominal_sigmas
from calib.rig import Rig
from omnid.errors import OmnidError

Array = NDArray[np.float64]

# Largest rotation of the upper camera, and of the baseline's direction, against a measured rig. A nominal rig does not
# know how its cameras were mounted: its limit is three of its sigmas (TURN_SIGMA_RAD in `rig_prior.py`).
MAX_TURN_RAD, MAX_NOMINAL_TURN_RAD = np.deg2rad(2.8), np.deg2rad(4.5)
# Largest change of a camera's parameter, in sigmas of a nominal rig: 1 of 16,000 normal errors is larger.
MAX_CHANGE_SIGMAS = 4.0


def require_same_rig(parameters: RigParameters, steps: Array, *, tracked: bool = True) -> None:
    """Raise OmnidError where the drive asks for another rig than the one given; tracked: as of `different_rig`."""
    reason = different_rig(parameters, steps, tracked=tracked)
    if reason:
        raise OmnidError(
            f"calibrate drive: {reason}; is the rig that of these cameras? Nothing is written for another "
            "one: start from its own or nominal rig"
        )


def different_rig(parameters: RigParameters, steps: Array, *, tracked: bool = True) -> str:
    """Return by which a rig after steps (P,) is not the one of the parameters; empty where it may be.

    tracked: False before the motion is known: an upper camera that is exposed late then appears shifted.
    """
    first = len(parameters.rig_names) - len(TRANSFORM_NAMES)
    change = (steps * parameters.units)[first : len(parameters.rig_names)]
    turn, lean = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:])) if tracked else 0.0
    limit = MAX_NOMINAL_TURN_RAD if is_nominal(parameters.rig) else MAX_TURN_RAD
    if max(turn, lean) > limit:
        return (
            f"the upper camera is turned by {np.rad2deg(turn):.1f} deg and its baseline by {np.rad2deg(lean):.1f} deg "
            f"against the rig's file, expected {np.rad2deg(limit):.1f} deg at most"
        )
    away = np.abs(steps / nominal_sigmas(parameters))[:first]
    worst = int(np.argmax(away))
    if away[worst] <= MAX_CHANGE_SIGMAS:
        return ""
    old, new = parameters.values[worst], (parameters.values + steps * parameters.units)[worst]
    return (
        f"{parameters.names[worst]} would change from {old:.5g} to {new:.5g}, more than another calibration of the "
        "same camera and mirror"
    )


def is_nominal(rig: Rig) -> bool:
    """True if a rig was not measured: no covariance, and one camera exactly above the other without any rotation."""
    T = rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig)
    straight = np.allclose(T[:3, :3], np.eye(3), atol=1e-9) and np.allclose(T[:2, 3], 0, atol=1e-9)
    return rig.covariance is None and bool(straight)
