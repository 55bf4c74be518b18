"""Estimate of a rig's errors from a window of keyframes: a bundle adjustment about the rig of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.fit.drive_bundle import adjust_drive, observation_sigma
from calib.fit.drive_parameters import RigParameters
from calib.fit.drive_prior import prior_information
from calib.fit.drive_problem import DriveObservations, DriveState
from calib.fit.rig_fit import has_wavefront
from calib.rig import Rig
from omnid.calibration.drive_scale import scale_change, scale_gradient

Array = NDArray[np.float64]

# A change counts if landmarks fit that much better, and if one parameter changes by so many sigmas. A right rig of
# rendered rooms keeps 0.96 to 1.00 of its error, one with centres 0.3 px off has 4 to 8 times that of the new one.
MAX_ERROR_RATIO, MIN_SIGMAS = 0.85, 5.0


@dataclass(frozen=True, slots=True)
class RefinementRequest:
    """A window of keyframes, by the rig of the run."""

    rig: Rig
    state: DriveState
    observations: DriveObservations


@dataclass(frozen=True, slots=True)
class RigChange:
    """The rig that a window asks for, beside the one of the run; values (P,) in the parameters' own units."""

    rig: Rig
    names: tuple[str, ...]
    before: Array
    after: Array
    sigmas: Array
    lengths: float  # relative change of lengths
    lengths_sigma: float
    error_px: float  # of a landmark's coordinate with the rig of the run
    refined_error_px: float  # and with the new one
    keyframes: int
    landmarks: int

    @property
    def is_significant(self) -> bool:
        """True if the rig of the run does not fit what the cameras see."""
        sigmas = float(np.max(np.abs(self.after - self.before) / self.sigmas))
        return self.refined_error_px < MAX_ERROR_RATIO * self.error_px and sigmas > MIN_SIGMAS


def estimate(request: RefinementRequest) -> RigChange:
    """Return the rig that fits a window best; CalibError where it does not tell."""
    rig = request.rig
    parameters = RigParameters.about(rig, waves=any(has_wavefront(one.camera) for one in (rig.lower, rig.upper)))
    prior, none = prior_information(parameters, rig), np.zeros(len(parameters.names))
    found = adjust_drive(parameters, replace(request.state, steps=none), request.observations, prior)
    gradient = scale_gradient(found)
    return RigChange(found.rig, parameters.names, parameters.values,
                     parameters.values + found.state.steps * parameters.units, found.sigmas * parameters.units,
                     scale_change(found, rig), float(np.sqrt(gradient @ found.covariance @ gradient)),
                     observation_sigma(rig, found), found.sigma_px, len(found.state.T_rig_odom),
                     len(found.state.points))
