"""Prior of a rig before a drive: the covariance of its calibration, or the tolerances of a nominal rig."""

from __future__ import annotations

import numpy as np

from calib.errors import CalibError
from calib.fit.drive.rig_parameters import TIME_UNITS, TRANSFORM_NAMES, RigParameters
from calib.models.camera import Array
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig import Rig

# A nominal rig: mirror data sheet, rim of the mirror in the images, baseline by ruler.
XI_SIGMA, FOCAL_SIGMA, CENTRE_SIGMA_PX, DISTORTION_SIGMA_PX, TANGENTIAL_SIGMA_PX = 0.02, 0.02, 3.0, 1.0, 3.0
TURN_SIGMA_RAD, DIRECTION_SIGMA_RAD = np.deg2rad(1.5), np.deg2rad(2.0)
RULER_SIGMA_M = 0.5e-3
# Powers of the polynomial that have this prior, because the largest one has 63; 0 for a paraboloid. 0 for a
# paraboloid.
HIGHER_POWERS, POLYNOMIAL_SIGMA_PX = tuple(f"a{power}" for power in range(3, 64)), 0.5
WAVEFRONT_SIGMA_M = 1e-3  # because a ray of a mirror camera passes the viewpoint within about a millimetre
# Cameras without a trigger, and lines of a rolling shutter.
DELAY_SIGMA_MS, LINE_TIME_SIGMA_US = 15.0, 30.0
# Smallest part of a nominal sigma to which a board's covariance is trusted, because mirrors are knocked and metal
# grows.
MIN_PART = 1e-3


def prior_information(parameters: RigParameters, rig: Rig) -> Array:
    """Return the information (P, P) of the steps about zero, by the rig's covariance as far as it has one."""
    sigmas = nominal_sigmas(parameters)
    names = [name for name in parameters.names if rig.covariance is not None and name in rig.covariance.names]
    if rig.covariance is None or not names:
        return np.diag(sigmas**-2)
    chosen = [parameters.names.index(name) for name in names]
    units = parameters.units[chosen]
    known = rig.covariance.select(names).matrix / np.outer(units, units)
    matrix = np.diag(sigmas**2)
    matrix[np.ix_(chosen, chosen)] = known + np.diag((MIN_PART * sigmas[chosen]) ** 2)
    return np.asarray(np.linalg.inv(matrix))


def nominal_sigmas(parameters: RigParameters) -> Array:
    """Return the sigmas (P,) of the steps of a nominal rig; a step moves the image by about a pixel."""
    rows = zip(parameters.names, parameters.values, parameters.units, strict=True)
    return np.array([_nominal_sigma(name, value, unit) for name, value, unit in rows])


def _nominal_sigma(name: str, value: float, unit: float) -> float:
    """Return the sigma of a parameter in steps."""
    if name in TRANSFORM_NAMES:
        return float((TURN_SIGMA_RAD if name.startswith("r_") else DIRECTION_SIGMA_RAD) / unit)
    if name in TIME_UNITS:
        return (DELAY_SIGMA_MS if name.endswith("[ms]") else LINE_TIME_SIGMA_US) / unit
    own = name.split()[-1]
    if own in WAVEFRONT_NAMES:
        return WAVEFRONT_SIGMA_M / unit
    if own in ("pu", "pv", "center_row", "center_column"):
        return CENTRE_SIGMA_PX / unit
    if own == "xi":
        return XI_SIGMA / unit
    if own in ("p1", "p2"):
        return TANGENTIAL_SIGMA_PX
    if own in ("k1", "k2", "c", "d", "s1", "s2"):
        return DISTORTION_SIGMA_PX
    if own in HIGHER_POWERS:
        return float(np.hypot(POLYNOMIAL_SIGMA_PX, FOCAL_SIGMA * value / unit))
    return FOCAL_SIGMA * abs(value) / unit  # focal lengths and coefficients of a polynomial


def baseline_by_prior(rig: Rig, names: tuple[str, ...], change: Array, covariance: Array) -> tuple[float, Array]:
    """Return the length of the baseline [m] and the covariance (P + 1, P + 1) of names and length.

    Images do not show the length. Where the rig's covariance relates it to other parameters, their change (P,) and
    covariance (P, P), in their own units, move it: the conditional of a normal distribution.
    """
    count = len(names)
    gain, variance = np.zeros(count), RULER_SIGMA_M**2
    if rig.covariance is not None and "baseline" in rig.covariance.names:
        chosen = [k for k, name in enumerate(names) if name in rig.covariance.names]
        prior = rig.covariance.select([*(names[k] for k in chosen), "baseline"]).matrix
        scale = np.sqrt(np.maximum(np.diag(prior)[:-1], np.finfo(float).tiny))
        try:
            gain[chosen] = np.linalg.solve(prior[:-1, :-1] / np.outer(scale, scale), prior[:-1, -1] / scale) / scale
        except np.linalg.LinAlgError:
            raise CalibError("calibrate drive: the covariance of the rig's file is singular") from None
        variance = max(0.0, float(prior[-1, -1] - gain[chosen] @ prior[:-1, -1]))
    J = np.vstack([np.eye(count), gain])
    matrix = J @ covariance @ J.T
    matrix[-1, -1] += variance
    return rig.baseline_m + float(gain @ change), np.asarray(matrix)
