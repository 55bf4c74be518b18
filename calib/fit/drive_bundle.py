"""Bundle adjustment of a rig from a drive: poses of keyframes, landmarks, both cameras and the transform between them.

What a drive shows of a rig: the centre of each camera and the tilt between them, from the columns; the mapping from
radius to elevation, because the same landmark is seen from near and from far. A stretch of that mapping along the
baseline looks the same as a stretched world as long as the rig moves in one plane and does not tilt; only the form of
the camera model and the prior hold it. The baseline keeps its length, for images alone do not show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.fit.drive_parameters import RigParameters
from calib.fit.drive_problem import KERNEL, DriveObservations, DriveProblem, DriveState, Flags, linearise
from calib.models.camera import Array
from calib.rig import Rig

MIN_SIGMA_PX = 0.01
MAX_SIGMA_PX = 1.0  # observations that fit no better are not of one rigid world
LOOSE_LANDMARK = 2.0  # a landmark whose errors' RMS exceeds so many sigmas is not one point of one surface
LOOSE_OBSERVATION = 6.0
SELECTIONS = 3  # rounds of leaving out loose landmarks
MAX_STEPS = 30  # of a search
ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-6  # relative gain below which a search ends, while landmarks are selected and last
MAX_TRIALS = 8  # of a damping
MIN_LANDMARKS = 100
# Errors of a patch are alike in both cameras, and from keyframe to keyframe (correlation 0.9 in rendered rooms):
# beside a calibration with boards about one observation of ten counts.
OBSERVATIONS_ALIKE = 10.0
HOLD_OUT = 3  # every third landmark is held out of a comparison of models
MAD_TO_SIGMA = 1.4826  # of a normal distribution


@dataclass(frozen=True, slots=True)
class DriveAdjustment:
    """The rig that fits a drive, and how well; covariance and prior information (P, P) are of the steps."""

    parameters: RigParameters
    state: DriveState
    observations: DriveObservations
    covariance: Array  # (P, P)
    sigma_px: float  # of one coordinate of an observation
    prior: Array

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
        """True (P,) for the parameters of which the drive told more than the prior."""
        return np.asarray(self.sigmas < np.sqrt(np.diag(np.linalg.inv(self.prior))) / 2)


def adjust_drive(parameters: RigParameters, state: DriveState, observations: DriveObservations, prior: Array,
                 fixed: Sequence[int] = (0,), *, alike: float = 1.0) -> DriveAdjustment:
    """Return the rig, poses and landmarks of least robust reprojection error near those given.

    prior: information (P, P) of the steps about zero. fixed: keyframes whose pose stays, one for each drive. alike:
    number of observations that tell no more than one, which gives the prior more weight. CalibError where fewer than
    MIN_LANDMARKS landmarks agree.
    """
    problem = DriveProblem(parameters, observations, alike * prior, np.asarray(fixed))
    state, sigma_px = _descend(problem, state, ROUGH_GAIN)
    for number in range(SELECTIONS):
        kept, used = observations.only(_consistent(problem, state, sigma_px))
        if sigma_px > MAX_SIGMA_PX:
            raise CalibError(f"calibrate drive: the landmarks are {sigma_px:.1f} px off any rig and path, expected "
                             f"{MAX_SIGMA_PX:.0f} px at most; is the rig that of these cameras?")
        if len(used) < MIN_LANDMARKS:
            raise CalibError(f"calibrate drive: only {len(used)} landmarks agree with a rigid world, {MIN_LANDMARKS} "
                             "are needed; is the rig that of these cameras, is there enough to see?")
        observations, state = kept, replace(state, points=state.points[used])
        problem = replace(problem, observations=observations)
        state, sigma_px = _descend(problem, state, FINE_GAIN if number == SELECTIONS - 1 else ROUGH_GAIN)
    covariance = linearise(problem, state, sigma_px).covariance(alike**2 * prior)
    return DriveAdjustment(parameters, state, observations, covariance, sigma_px, prior)


def adjust_pairs(parameters: RigParameters, state: DriveState, observations: DriveObservations, prior: Array) -> Array:
    """Return the steps (P,) by points that both cameras saw at once, near those of the state: a start for a drive.

    Rays of both cameras must meet: columns of the panoramas, but no lengths. The poses of the keyframes do not matter.
    """
    everything = np.arange(len(state.T_rig_odom))
    return _descend(DriveProblem(parameters, observations, prior, everything), state, ROUGH_GAIN)[0].steps


def held_out_error(parameters: RigParameters, found: DriveAdjustment, prior: Array, fixed: Sequence[int] = (0,)
                   ) -> float:
    """Return the error [px] of landmarks that another model of the rig was not fitted to; robust (Cauchy's function).

    Rig and poses are fitted to the other landmarks of an adjustment; then only the points of those held out are.
    """
    held = found.observations.landmark % HOLD_OUT == 0
    parts = [found.observations.only(chosen) for chosen in (~held, held)]
    states = [replace(found.state, points=found.state.points[used], steps=np.zeros(len(prior))) for _, used in parts]
    steps = dict(zip(found.parameters.names, found.state.steps.tolist(), strict=True))
    states[0] = replace(states[0], steps=np.array([steps.get(name, 0.0) for name in parameters.names]))
    fitted, _ = _descend(DriveProblem(parameters, parts[0][0], prior, np.asarray(fixed)), states[0], FINE_GAIN)
    everything = np.arange(len(fitted.T_rig_odom))
    test = DriveProblem(parameters, parts[1][0], prior, everything, held=True)
    tried, _ = _descend(test, replace(fitted, points=states[1].points), ROUGH_GAIN)
    squared = (test.residuals(tried) ** 2).sum(axis=1) / (KERNEL * found.sigma_px) ** 2
    return float(KERNEL * found.sigma_px * np.sqrt(np.mean(np.log1p(squared)) / 2))


def observation_sigma(rig: Rig, found: DriveAdjustment, fixed: Sequence[int] = (0,)) -> float:
    """Return the sigma [px] of one coordinate with another rig, which stays; poses and landmarks are adjusted to it."""
    parameters = RigParameters.about(rig)
    still = np.zeros(len(parameters.names))
    problem = DriveProblem(parameters, found.observations, np.eye(len(still)), np.asarray(fixed), held=True)
    return _descend(problem, replace(found.state, steps=still), ROUGH_GAIN)[1]


def _descend(problem: DriveProblem, state: DriveState, least_gain: float) -> tuple[DriveState, float]:
    """Search by Levenberg and Marquardt; return the state and the sigma [px] of one coordinate."""
    damping = 1e-4
    for _ in range(MAX_STEPS):
        sigma_px = _spread(problem.residuals(state))
        cost, normal = problem.cost(state, sigma_px), linearise(problem, state, sigma_px)
        trial, gain = state, 0.0
        for _ in range(MAX_TRIALS):
            found = _moved(problem, state, *normal.step(damping))
            gain = cost - problem.cost(found, sigma_px) if found is not None else -np.inf
            if found is not None and gain > 0:
                trial = found
                break
            damping *= 10
        if gain <= 0:
            break
        state, damping = trial, max(1e-9, damping / 10)
        if gain < least_gain * cost:
            break
    return state, _spread(problem.residuals(state))


def _spread(residual: Array) -> float:
    """Return the standard deviation [px] of one coordinate, by the median."""
    return max(MIN_SIGMA_PX, MAD_TO_SIGMA * float(np.median(np.abs(residual))))


def _moved(problem: DriveProblem, state: DriveState, step: Array, landmarks: Array) -> DriveState | None:
    """Return the state after a step; None where no camera is that way."""
    P = len(problem.prior)
    T = state.T_rig_odom.copy()
    free = np.setdiff1d(np.arange(len(T)), problem.fixed)
    T[free] = se3.exp(step[:-P].reshape(-1, 6)) @ T[free]
    moved = replace(state, T_rig_odom=T, points=state.points + landmarks, steps=state.steps + step[-P:])
    try:
        problem.parameters.at(moved.steps)
    except CalibError:
        return None
    return moved


def _consistent(problem: DriveProblem, state: DriveState, sigma_px: float) -> Flags:
    """Return the observations (M,) of landmarks that behave as one point, without those that are far off."""
    seen, squared = problem.observations, (problem.residuals(state) ** 2).sum(axis=1)
    total, count = np.zeros(len(state.points)), np.zeros(len(state.points))
    np.add.at(total, seen.landmark, np.minimum(squared, 1.0))
    np.add.at(count, seen.landmark, 2)
    rms = np.sqrt(total / np.maximum(count, 1))
    firm = (rms < LOOSE_LANDMARK * sigma_px)[seen.landmark]
    return np.asarray(firm & (squared < (LOOSE_OBSERVATION * sigma_px) ** 2))
