"""Estimate of a rig's errors from a window of keyframes: a bundle adjustment about the rig of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.fit.drive_bundle import DriveAdjustment, adjust_drive, observation_sigma
from calib.fit.drive_parameters import TRANSFORM_NAMES, UPPER_DELAY, RigParameters
from calib.fit.drive_prior import baseline_by_prior, prior_information
from calib.fit.drive_problem import DriveObservations, DriveState
from calib.fit.rig_fit import has_wavefront
from calib.rig import Rig
from calib.rig_covariance import RigCovariance
from omnid.calibration.drive_scale import scale_change, scale_gradient

Array = NDArray[np.float64]

# A change counts if landmarks fit that much better, and if one parameter changes by so many sigmas. A right rig of
# rendered rooms keeps 0.96 to 1.00 of its error, one with centres 0.3 px off has 4 to 8 times that of the new one.
MAX_ERROR_RATIO, MIN_SIGMAS = 0.85, 5.0
MIN_DELAY_MS = 0.5  # least change of the upper camera's delay that counts, if it has MIN_SIGMAS as well
# Larger changes of lengths and of the upper camera's pose are told, but not applied: keyframes of before would no
# longer fit those of after, and a rig that is so wrong was knocked, or is another one.
MAX_APPLIED_LENGTHS, MAX_APPLIED_RAD = 0.05, np.deg2rad(1.0)


@dataclass(frozen=True, slots=True)
class RefinementRequest:
    """A window of keyframes, by the rig of the run; has_delay: the upper camera's delay is estimated as well."""

    rig: Rig
    state: DriveState
    observations: DriveObservations
    has_delay: bool = False


@dataclass(frozen=True, slots=True)
class RigChange:
    """The rig that a window asks for, with its covariance, beside the one of the run; values (P,) in their own units.

    The rig differs from the one of the run in what has changed significantly: geometry, or delay, or both.
    """

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
        return self.has_moved or self.has_delay

    @property
    def has_moved(self) -> bool:
        """True if a camera or the transform between the cameras does not fit."""
        of_geometry = np.array(self.names) != UPPER_DELAY
        sigmas = float(np.max((np.abs(self.after - self.before) / self.sigmas)[of_geometry]))
        return self.refined_error_px < MAX_ERROR_RATIO * self.error_px and sigmas > MIN_SIGMAS

    @property
    def delay_ms(self) -> tuple[float, float, float] | None:
        """The delay of the upper camera's exposures against the stamps before and after [ms], and its sigma."""
        if UPPER_DELAY not in self.names:
            return None
        k = self.names.index(UPPER_DELAY)
        return float(self.before[k]), float(self.after[k]), float(self.sigmas[k])

    @property
    def has_delay(self) -> bool:
        """True if the upper camera is exposed at other times than the stamps and the rig of the run say."""
        if self.delay_ms is None:
            return False
        before, after, sigma = self.delay_ms
        return abs(after - before) > max(MIN_DELAY_MS, MIN_SIGMAS * sigma)

    @property
    def is_small(self) -> bool:
        """True if a run may go on with the rig."""
        moved = [abs(after - before) for name, before, after in zip(self.names, self.before, self.after, strict=True)
                 if name in TRANSFORM_NAMES]
        return not self.has_moved or (abs(self.lengths) <= MAX_APPLIED_LENGTHS and max(moved) <= MAX_APPLIED_RAD)


def estimate(request: RefinementRequest) -> RigChange:
    """Return the rig that fits a window best; CalibError where it does not tell."""
    rig, times = request.rig, (UPPER_DELAY,) if request.has_delay else ()
    parameters = RigParameters.about(rig, times=times,
                                     waves=any(has_wavefront(one.camera) for one in (rig.lower, rig.upper)))
    prior, none = prior_information(parameters, rig), np.zeros(len(parameters.names))
    found = adjust_drive(parameters, replace(request.state, steps=none), request.observations, prior)
    gradient = scale_gradient(found)
    change = RigChange(rig, parameters.names, parameters.values,
                       parameters.values + found.state.steps * parameters.units, found.sigmas * parameters.units,
                       scale_change(found, rig), float(np.sqrt(gradient @ found.covariance @ gradient)),
                       observation_sigma(rig, found), found.sigma_px, len(found.state.T_rig_odom),
                       len(found.state.points))
    refined = _with_covariance(found, rig) if change.has_moved else rig
    return replace(change, rig=replace(refined, times=found.rig.times if change.has_delay else rig.times))


def _with_covariance(found: DriveAdjustment, before: Rig) -> Rig:
    """Return the adjusted rig with the covariance of its parameters and of its baseline, whose length stays."""
    names, units = found.parameters.rig_names, found.parameters.units[:len(found.parameters.rig_names)]
    change = found.state.steps[:len(names)] * units
    covariance = found.covariance[:len(names), :len(names)] * np.outer(units, units)
    _, matrix = baseline_by_prior(before, names, change, covariance)
    return replace(found.rig, covariance=RigCovariance.of_matrix([*names, "baseline"], matrix))
