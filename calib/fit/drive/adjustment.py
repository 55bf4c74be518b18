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
from calib.fit.drive.problem import KERNEL, DriveProblem
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.least_squares import Ending, minimise
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
# A search ends after this number of steps, or where a step reduces the cost by less than a share of it: the rough one
# while landmarks are still selected, because the search goes on with the next selection, the fine one at the end.
MAX_STEPS = 30
ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-6
# About six times the number of parameters of a rig. Fewer landmarks would not show that a parameter is wrong.
MIN_LANDMARKS = 100
# Errors of a patch are alike in both cameras, and from keyframe to keyframe (correlation 0.9 in rendered rooms),
# so ten of these observations tell about as much as one corner in a calibration by boards.
OBSERVATIONS_ALIKE = 10.0
# Every third landmark is held out of a comparison of models, so that most remain for the fit.
HOLD_OUT = 3


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
    prior: Array,
    fixed: Sequence[int] = (0,),
    *,
    alike: float = 1.0,
) -> DriveAdjustment:
    """Return the rig, poses and landmarks of least robust reprojection error near those given.

    prior: information (P, P) of the steps about zero. fixed: keyframes whose pose stays, one for each drive. alike:
    number of observations that tell as much as one independent one; the prior gets so many times its weight.
    CalibError where fewer than MIN_LANDMARKS landmarks agree.
    """
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


def adjust_pairs(parameters: RigParameters, state: DriveState, observations: DriveObservations, prior: Array) -> Array:
    """Return the steps (P,) by points that both cameras saw at once, near those of the state: a start for a drive.

    The only condition is that the rays of both cameras meet. It tells the columns of the panoramas, but no lengths. The
    poses of all keyframes stay; wherever they are, the result is the same.
    """
    everything = np.arange(len(state.T_rig_odom))
    return _minimised(DriveProblem(parameters, observations, prior, everything), state, ROUGH_GAIN)[0].steps


def held_out_error(
    parameters: RigParameters, found: DriveAdjustment, prior: Array, fixed: Sequence[int] = (0,)
) -> float:
    """Return the error [px] of landmarks that another model of the rig was not fitted to; robust (Cauchy's function).

    parameters: of the other model. found: an adjustment, which gives observations, poses and points to start from.
    """
    # 1. The landmarks in two parts: those for the fit, and those held out.
    held = found.observations.landmark % HOLD_OUT == 0
    parts = [found.observations.only(chosen) for chosen in (~held, held)]
    states = [replace(found.state, points=found.state.points[used], steps=np.zeros(len(prior))) for _, used in parts]
    # 2. The rig of the other model and the poses, by the first part; parameters that both models have start alike.
    steps = dict(zip(found.parameters.names, found.state.steps.tolist(), strict=True))
    states[0] = replace(states[0], steps=np.array([steps.get(name, 0.0) for name in parameters.names]))
    fitted, _ = _minimised(DriveProblem(parameters, parts[0][0], prior, np.asarray(fixed)), states[0], FINE_GAIN)
    # 3. With that rig and those poses, the points that are held out.
    everything = np.arange(len(fitted.T_rig_odom))
    test = DriveProblem(parameters, parts[1][0], prior, everything, held=True)
    tried, _ = _minimised(test, replace(fitted, points=states[1].points), ROUGH_GAIN)
    # 4. Their robust mean error.
    squared = (test.residuals(tried) ** 2).sum(axis=1) / (KERNEL * found.sigma_px) ** 2
    return float(KERNEL * found.sigma_px * np.sqrt(np.mean(np.log1p(squared)) / 2))


def observation_sigma(rig: Rig, found: DriveAdjustment, fixed: Sequence[int] = (0,)) -> float:
    """Return the sigma [px] of one coordinate with another rig, which stays; poses and landmarks are adjusted."""
    parameters = RigParameters.about(rig)
    still = np.zeros(len(parameters.names))
    problem = DriveProblem(parameters, found.observations, np.eye(len(still)), np.asarray(fixed), held=True)
    return _minimised(problem, replace(found.state, steps=still), ROUGH_GAIN)[1]


def _minimised(problem: DriveProblem, state: DriveState, gain: float) -> tuple[DriveState, float]:
    """Return the state of least cost, and the standard deviation [px] of one coordinate there."""
    found = minimise(problem, state, Ending(MAX_STEPS, gain))
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
