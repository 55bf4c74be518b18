"""Bundle adjustment of a rig from a drive: poses of keyframes, landmarks, both cameras and the transform between them.

What a drive shows of a rig: the centre of each camera and the tilt between them, from the columns; the mapping from
radius to elevation, because the same landmark is seen from near and from far. A stretch of that mapping along the
baseline cannot be distinguished from a stretched world as long as the rig moves in one plane and does not tilt; only
the form of the camera model and the prior hold it. The baseline keeps its length, for images alone do not show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.fit.drive.observations import DriveObservations, DriveState, Flags
from calib.fit.drive.problem import DriveProblem
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.least_squares import Ending, minimise
from calib.fit.residual_structure import OUTLIER_RATIO, ResidualStructure, systematic_px
from calib.models.camera import Array
from calib.rig import Rig

# Patches are matched to a tenth of a pixel, so that observations that fit no better than to a pixel show no rigid
# world.
MAX_SIGMA_PX = 1.0
# A landmark is not one point of one surface if the RMS of its errors exceeds the first number of sigmas. An
# observation is a wrong match if its error exceeds the second. The robust kernel alone would leave them some weight.
LOOSE_LANDMARK, LOOSE_OBSERVATION = 2.0, 6.0
# Loose landmarks are left out in several rounds, because the rig moves without them, and others become loose.
SELECTIONS = 3
# A search ends where a step reduces the cost by less than a share of it: the rough one while landmarks are still
# selected, because the search goes on with the next selection, the fine one at the end.
ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-6
# Information of parameters that stay.
HELD = 1e12
# About six times the number of parameters of a rig. Fewer landmarks would not show that a parameter is wrong.
MIN_LANDMARKS = 100
# Errors of a patch are alike in both cameras, and from keyframe to keyframe (correlation 0.9 in rendered rooms),
# so ten of these observations tell about as much as one corner in a calibration by boards.
OBSERVATIONS_ALIKE = 10.0


@dataclass(frozen=True, slots=True)
class DriveAdjustment:
    """The rig that fits a drive, and how well."""

    parameters: RigParameters
    state: DriveState
    observations: DriveObservations  # those that were used
    covariance: Array  # (P, P) of the steps
    sigma_px: float  # of one coordinate of an observation
    prior: Array  # (P, P) information of the steps about zero

    @property
    def rig(self) -> Rig:
        """The adjusted rig."""
        return self.parameters.at(self.state.steps)

    @property
    def sigmas(self) -> Array:
        """Standard deviations (P,) of the steps."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def seen(self) -> Flags:
        """True (P,) for the parameters whose sigma the drive has reduced to less than half of that of the prior."""
        return np.asarray(self.sigmas < np.sqrt(np.diag(np.linalg.inv(self.prior))) / 2)


def adjust_drive(
    parameters: RigParameters,
    state: DriveState,
    observations: DriveObservations,
    fixed: Sequence[int] = (0,),
    *,
    alike: float = 1.0,
) -> DriveAdjustment:
    """Return the rig, poses and landmarks of least robust reprojection error near those given.

    fixed: keyframes whose pose stays, one for each drive. alike: number of observations that tell as much as one
    independent one; the prior of the parameters gets so many times its weight.
    CalibError where fewer than MIN_LANDMARKS landmarks agree.
    """
    prior = parameters.prior()
    problem = DriveProblem(parameters, observations, alike * prior, np.asarray(fixed))
    state, sigma_px = _minimised(problem, state, ROUGH_GAIN)
    for number in range(SELECTIONS):
        kept, used = observations.only(_consistent(problem, state, sigma_px))
        if sigma_px > MAX_SIGMA_PX:
            raise CalibError(
                f"calibrate drive: the landmarks are {sigma_px:.1f} px off any rig and path, expected "
                f"{MAX_SIGMA_PX:.0f} px at most; is the rig that of these cameras?"
            )
        if len(used) < MIN_LANDMARKS:
            raise CalibError(
                f"calibrate drive: only {len(used)} landmarks agree with a rigid world, {MIN_LANDMARKS} "
                "are needed; is the rig that of these cameras, is there enough to see?"
            )
        observations, state = kept, replace(state, points=state.points[used])
        problem = replace(problem, observations=observations)
        state, sigma_px = _minimised(problem, state, FINE_GAIN if number == SELECTIONS - 1 else ROUGH_GAIN)
    covariance = problem.covariance(state, sigma_px, alike**2 * prior)
    return DriveAdjustment(parameters, state, observations, covariance, sigma_px, prior)


def adjust_pairs(parameters: RigParameters, state: DriveState, observations: DriveObservations) -> Array:
    """Return the steps (P,) by points that both cameras saw at once, near those of the state: a start for a drive.

    The only condition is that the rays of both cameras meet. It tells the columns of the panoramas, but no lengths. The
    poses of all keyframes stay; wherever they are, the result is the same.
    """
    everything = np.arange(len(state.T_rig_odom))
    return _minimised(DriveProblem(parameters, observations, parameters.prior(), everything), state, ROUGH_GAIN)[
        0
    ].steps


def drive_structure(found: DriveAdjustment) -> tuple[ResidualStructure, ResidualStructure]:
    """Return the systematic part and the noise of the residuals in the lower and in the upper image."""
    problem = DriveProblem(found.parameters, found.observations, found.prior, np.zeros(1, int))
    residuals, seen, rig = problem.residuals(found.state), found.observations, found.rig
    structures = []
    for camera, mounted in enumerate((rig.lower, rig.upper)):
        own = residuals[seen.camera == camera]
        systematic = systematic_px(seen.pixels[seen.camera == camera], own, mounted.camera.center)
        length = np.linalg.norm(own, axis=1)
        usual = own[length < OUTLIER_RATIO * np.median(length)]
        noise = float(np.sqrt(max(0.0, float(np.mean(usual**2)) - systematic**2)))
        structures.append(ResidualStructure(systematic, noise))
    return structures[0], structures[1]


def observation_sigma(rig: Rig, found: DriveAdjustment, fixed: Sequence[int] = (0,)) -> float:
    """Return the sigma [px] of one coordinate with another rig, which stays; poses and landmarks are adjusted."""
    parameters = RigParameters.about(rig)
    still = np.zeros(len(parameters.names))
    held = np.eye(len(still)) * HELD
    problem = DriveProblem(parameters, found.observations, held, np.asarray(fixed))
    return _minimised(problem, replace(found.state, steps=still), ROUGH_GAIN)[1]


def _minimised(problem: DriveProblem, state: DriveState, gain: float) -> tuple[DriveState, float]:
    """Return the state of least cost, and the standard deviation [px] of one coordinate there."""
    found = minimise(problem, state, Ending(gain))
    return found, problem.scale(found)


def _consistent(problem: DriveProblem, state: DriveState, sigma_px: float) -> Flags:
    """Return True (M,) for observations that are not far off, of landmarks that behave as one point."""
    seen, squared = problem.observations, (problem.residuals(state) ** 2).sum(axis=1)
    total, count = np.zeros(len(state.points)), np.zeros(len(state.points))
    np.add.at(total, seen.landmark, np.minimum(squared, 1.0))
    np.add.at(count, seen.landmark, 2)
    rms = np.sqrt(total / np.maximum(count, 1))
    firm = (rms < LOOSE_LANDMARK * sigma_px)[seen.landmark]
    return np.asarray(firm & (squared < (LOOSE_OBSERVATION * sigma_px) ** 2))
