"""Estimate of a rig's errors from a window of keyframes: a bundle adjustment about the rig of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.fit.drive.adjustment import DriveAdjustment, adjust_drive, observation_sigma
from calib.fit.drive.observations import DriveObservations, DriveState
from calib.fit.drive.rig_parameters import UPPER_DELAY, RigParameters
from calib.fit.drive.rig_prior import baseline_by_prior, prior_information
from calib.models.ocam import has_wavefront
from calib.rig import Rig
from calib.rig_covariance import RigCovariance
from omnid.calibration.drive_scale import scale_change, scale_gradient

Array = NDArray[np.float64]

# Error of the landmarks after a change that counts, per error before. A right rig of rendered rooms keeps 0.96 to 1.00
# of its error; one with centres 0.3 px off has 4 to 8 times that of the new one.
MAX_ERROR_RATIO: Final = 0.85
# Sigmas by which one parameter of a change that counts has changed: a rig has some twenty, and none may by chance.
MIN_SIGMAS: Final = 5.0
# Change of the upper camera's delay that counts: at 1 m/s half a millimetre, 0.02 px at a distance of 5 m.
MIN_DELAY_MS: Final = 0.5


@dataclass(frozen=True, slots=True)
class RefinementRequest:
    """A window of keyframes, by the rig of the run; has_delay: the upper camera's delay is estimated as well."""

    rig: Rig
    state: DriveState
    observations: DriveObservations
    has_delay: bool = False


@dataclass(frozen=True, slots=True)
class RigChange:
    """The rig that fits a window, with its covariance, and what changes against the run's; values (P,) in their units.

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


def estimate(request: RefinementRequest) -> RigChange:
    """Return the rig that fits a window best; CalibError where the window does not determine it."""
    # 1. Bundle adjustment of cameras, transform, times, poses and landmarks, with the calibration as prior.
    rig, times = request.rig, (UPPER_DELAY,) if request.has_delay else ()
    parameters = RigParameters.about(
        rig, times=times, waves=any(has_wavefront(one.camera) for one in (rig.lower, rig.upper))
    )
    prior, none = prior_information(parameters, rig), np.zeros(len(parameters.names))
    found = adjust_drive(parameters, replace(request.state, steps=none), request.observations, prior)
    # 2. What it changes, and the change of lengths that follows.
    gradient = scale_gradient(found)
    change = RigChange(
        rig,
        parameters.names,
        parameters.values,
        parameters.values + found.state.steps * parameters.units,
        found.sigmas * parameters.units,
        scale_change(found, rig),
        float(np.sqrt(gradient @ found.covariance @ gradient)),
        observation_sigma(rig, found),
        found.sigma_px,
        len(found.state.T_rig_odom),
        len(found.state.points),
    )
    # 3. Only what has changed significantly is taken over.
    refined = _with_covariance(found, rig) if change.has_moved else rig
    return replace(change, rig=replace(refined, times=found.rig.times if change.has_delay else rig.times))


def _with_covariance(found: DriveAdjustment, before: Rig) -> Rig:
    """Return the adjusted rig with the covariance of its parameters and of its baseline, whose length stays."""
    names, units = found.parameters.rig_names, found.parameters.units[: len(found.parameters.rig_names)]
    change = found.state.steps[: len(names)] * units
    covariance = found.covariance[: len(names), : len(names)] * np.outer(units, units)
    _, matrix = baseline_by_prior(before, names, change, covariance)
    return replace(found.rig, covariance=RigCovariance.of_matrix([*names, "baseline"], matrix))
