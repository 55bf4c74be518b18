"""Bundle adjustment of a rig from a drive: poses of keyframes, landmarks, both cameras and the transform between them.

Landmarks are eliminated from the normal equations (Schur complement; Triggs et al. 2000, section 6), so that a dense
system of the size of keyframes and rig is solved. The baseline keeps its length, for images alone do not show it.

What a drive shows of a rig: the centre of each camera and the tilt between them, from the columns; the mapping from
radius to elevation, because the same landmark is seen from near and from far. A stretch of that mapping along the
baseline looks the same as a stretched world as long as the rig moves in one plane and does not tilt; only the form of
the camera model and the prior hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calib import se3
from calib.errors import CalibError
from calib.fit.parameterisation import CameraParameterisation, parameterise
from calib.models.camera import Array
from calib.rig import Rig

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

STEP = 1e-4  # of numeric derivatives, in steps of a parameter (about a pixel each) or in parts of a point's distance
ANGLE_UNIT_RAD = 1.0 / 250.0  # one step of the transform between the cameras: about a pixel
KERNEL = 3.0  # sigmas at which Cauchy's kernel begins to count an error less
MIN_SIGMA_PX = 0.01
MAX_SIGMA_PX = 1.0  # observations that fit no better are not of one rigid world
LOST_PX = 50.0  # error of an observation whose point the model does not project
LOOSE_LANDMARK = 2.0  # a landmark whose errors' RMS exceeds so many sigmas is not one point of one surface
LOOSE_OBSERVATION = 6.0
SELECTIONS = 3  # rounds of leaving out loose landmarks
MAX_STEPS = 30  # of a search
ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-6  # relative gain below which a search ends, while landmarks are selected and last
MAX_TRIALS = 8  # of a damping
HELD = 1e-9  # sigma of a step that stays zero
MIN_LANDMARKS = 100
TRANSFORM_NAMES = ("r_x", "r_y", "r_z", "e_x", "e_y")


@dataclass(frozen=True, slots=True)
class DriveObservations:
    """Pixels (M, 2) in the cameras' images (camera 0 lower, 1 upper) of landmarks, seen from keyframes."""

    keyframe: Indices  # (M,)
    landmark: Indices  # (M,)
    camera: Indices  # (M,)
    pixels: Array  # (M, 2)

    def __len__(self) -> int:
        return len(self.landmark)

    def only(self, kept: Flags) -> tuple[DriveObservations, Indices]:
        """Return the chosen observations with landmarks numbered again, and the old numbers of those."""
        used, landmark = np.unique(self.landmark[kept], return_inverse=True)
        return DriveObservations(self.keyframe[kept], landmark, self.camera[kept], self.pixels[kept]), used


@dataclass(frozen=True, slots=True)
class DriveState:
    """Poses of the keyframes, landmarks in odom and steps of the rig's parameters."""

    T_rig_odom: Array  # (K, 4, 4)
    points: Array  # (L, 3) m
    steps: Array  # (P,)


@dataclass(frozen=True, slots=True)
class RigParameters:
    """A rig as a function of steps: both cameras, then rotation (3) and direction of the baseline (2).

    The rig frame stays with the lower camera: moving that as well would only move all poses.
    """

    rig: Rig
    lower: CameraParameterisation
    upper: CameraParameterisation

    @staticmethod
    def about(rig: Rig) -> RigParameters:
        """Return the parameters of the cameras' own models about a rig."""
        return RigParameters(rig, parameterise(rig.lower.camera), parameterise(rig.upper.camera))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps."""
        return (*(f"lower {name}" for name in self.lower.names), *(f"upper {name}" for name in self.upper.names),
                *TRANSFORM_NAMES)

    @property
    def values(self) -> Array:
        """Values (P,) at no step, in the parameters' own units; the transform's are zero, in radians."""
        return np.concatenate([self.lower.start, self.upper.start, np.zeros(len(TRANSFORM_NAMES))])

    @property
    def units(self) -> Array:
        """One step (P,) in the parameters' own units."""
        return np.concatenate([self.lower.units, self.upper.units, np.full(len(TRANSFORM_NAMES), ANGLE_UNIT_RAD)])

    def at(self, steps: Array) -> Rig:
        """Return the rig after steps (P,); CalibError where there is no such camera."""
        first, second = len(self.lower.names), len(self.lower.names) + len(self.upper.names)
        rig, turn = self.rig, steps[second:] * ANGLE_UNIT_RAD
        R_rect_rig = rig.T_rect_rig[:3, :3]
        along = np.array([turn[3], turn[4], 1.0]) / np.linalg.norm([turn[3], turn[4], 1.0])
        viewpoint = rig.lower.viewpoint + rig.baseline_m * R_rect_rig.T @ along
        R_rig_upper = R_rect_rig.T @ se3.rotation_exp(turn[:3]) @ R_rect_rig @ rig.upper.T_cam_rig[:3, :3].T
        lower = replace(rig.lower, camera=self.lower.camera_at(steps[:first]))
        upper = replace(rig.upper, camera=self.upper.camera_at(steps[first:second]),
                        T_cam_rig=se3.inverse(se3.transform(R_rig_upper, viewpoint)))
        return replace(rig, lower=lower, upper=upper, covariance=None)


@dataclass(frozen=True, slots=True)
class DriveAdjustment:
    """The rig that fits a drive, and how well; sigmas and covariance are of the steps, the prior included."""

    parameters: RigParameters
    state: DriveState
    observations: DriveObservations
    covariance: Array  # (P, P)
    sigma_px: float  # of one coordinate of an observation
    prior: Array  # (P,) sigmas

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
        return np.asarray(self.sigmas < self.prior / 2)


def project(rig: Rig, camera: Indices, points: Array) -> Array:
    """Return pixels (M, 2) of points (M, 3) in the rig frame, each in its camera; NaN where there is no image."""
    pixels = np.full((len(points), 2), np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        at = np.flatnonzero(camera == side)
        pixels[at] = mounted.camera.project(se3.apply(mounted.T_cam_rig, points[at]))
    return pixels


def adjust_drive(parameters: RigParameters, state: DriveState, observations: DriveObservations, prior: Array,
                 fixed: Sequence[int] = (0,)) -> DriveAdjustment:
    """Return the rig, poses and landmarks of least robust reprojection error near those given.

    prior: sigmas (P,) of the steps about zero. fixed: keyframes whose pose stays, one for each drive. CalibError where
    fewer than MIN_LANDMARKS landmarks agree.
    """
    problem = _Problem(parameters, observations, prior, np.asarray(fixed))
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
    covariance = _linearise(problem, state, sigma_px).covariance(len(prior))
    return DriveAdjustment(parameters, state, observations, covariance, sigma_px, prior)


def observation_sigma(rig: Rig, found: DriveAdjustment, fixed: Sequence[int] = (0,)) -> float:
    """Return the sigma [px] of one coordinate with another rig, which stays; poses and landmarks are adjusted to it."""
    parameters = RigParameters.about(rig)
    still = np.zeros(len(parameters.names))
    problem = _Problem(parameters, found.observations, np.full(len(still), HELD), np.asarray(fixed))
    return _descend(problem, replace(found.state, steps=still), ROUGH_GAIN)[1]


@dataclass(frozen=True, slots=True)
class _Problem:
    """All that stays the same while the search goes on."""

    parameters: RigParameters
    observations: DriveObservations
    prior: Array
    fixed: Indices

    def residuals(self, state: DriveState) -> Array:
        """Return measured minus modelled pixels (M, 2); LOST_PX where the model has no image."""
        seen = self.observations
        cast = project(self.parameters.at(state.steps), seen.camera, self.in_rig(state))
        return np.where(np.isfinite(cast), seen.pixels - cast, LOST_PX)

    def in_rig(self, state: DriveState) -> Array:
        """Return the landmark (M, 3) of each observation in the rig frame of its keyframe."""
        T = state.T_rig_odom[self.observations.keyframe]
        return np.asarray((T[:, :3, :3] @ state.points[self.observations.landmark][:, :, None])[:, :, 0] + T[:, :3, 3])

    def cost(self, state: DriveState, sigma_px: float) -> float:
        """Return the sum of Cauchy's function over the observations, and the prior's."""
        squared = (self.residuals(state) ** 2).sum(axis=1) / sigma_px**2
        return float(KERNEL**2 * np.log1p(squared / KERNEL**2).sum() + ((state.steps / self.prior) ** 2).sum())


@dataclass(frozen=True, slots=True)
class _Normal:
    """Weighted normal equations: frames and rig (C), landmarks (3 x 3 blocks), and what couples them (C, 3 L)."""

    A: Array
    blocks: Array  # (L, 3, 3)
    coupling: sparse.csr_matrix
    a: Array
    b: Array  # (3 L,)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of frames and rig (C,) and of the landmarks (L, 3)."""
        inverse = self._inverse(damping)
        between = self.coupling @ inverse
        reduced = self.A + damping * np.diag(np.diag(self.A)) - (between @ self.coupling.T).toarray()
        step = np.linalg.solve(reduced, self.a - between @ self.b)
        return step, np.asarray(inverse @ (self.b - self.coupling.T @ step)).reshape(-1, 3)

    def covariance(self, parameters: int) -> Array:
        """Return the covariance (P, P) of the last so many of frames and rig."""
        reduced = self.A - (self.coupling @ self._inverse(0.0) @ self.coupling.T).toarray()
        return np.asarray(np.linalg.inv(reduced)[-parameters:, -parameters:])

    def _inverse(self, damping: float) -> sparse.csr_matrix:
        count = len(self.blocks)
        damped = self.blocks * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3)
        return sparse.bsr_matrix((np.linalg.inv(damped), np.arange(count), np.arange(count + 1)),
                                 (3 * count, 3 * count)).tocsr()


def _descend(problem: _Problem, state: DriveState, least_gain: float) -> tuple[DriveState, float]:
    """Search by Levenberg and Marquardt; return the state and the sigma [px] of one coordinate."""
    damping = 1e-4
    for _ in range(MAX_STEPS):
        sigma_px = _spread(problem.residuals(state))
        cost, normal = problem.cost(state, sigma_px), _linearise(problem, state, sigma_px)
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
    return max(MIN_SIGMA_PX, 1.4826 * float(np.median(np.abs(residual))))


def _moved(problem: _Problem, state: DriveState, step: Array, landmarks: Array) -> DriveState | None:
    """Return the state after a step; None where no camera is that way."""
    P = len(problem.prior)
    T = state.T_rig_odom.copy()
    free = np.setdiff1d(np.arange(len(T)), problem.fixed)
    T[free] = se3.exp(step[:-P].reshape(-1, 6)) @ T[free]
    moved = DriveState(T, state.points + landmarks, state.steps + step[-P:])
    try:
        problem.parameters.at(moved.steps)
    except CalibError:
        return None
    return moved


def _linearise(problem: _Problem, state: DriveState, sigma_px: float) -> _Normal:
    seen, residual = problem.observations, problem.residuals(state)
    squared = (residual**2).sum(axis=1) / sigma_px**2
    root = np.sqrt(1 / (1 + squared / KERNEL**2))[:, None] / sigma_px  # Cauchy's weight
    in_rig = problem.in_rig(state)
    by_rig_point = _by_point(problem.parameters.at(state.steps), seen.camera, in_rig) * root[:, :, None]
    by_point = by_rig_point @ state.T_rig_odom[seen.keyframe][:, :3, :3]
    by_pose = np.concatenate([by_rig_point, -by_rig_point @ se3.hat(in_rig)], axis=2)
    by_steps = (_by_steps(problem, state, in_rig) * root[:, :, None]).reshape(-1, len(problem.prior))
    error = (residual * root).ravel()
    J_points = _scattered(by_point, seen.landmark, len(state.points))
    J_poses = _scattered(by_pose, seen.keyframe, len(state.T_rig_odom))
    J_poses = J_poses[:, np.repeat(~np.isin(np.arange(len(state.T_rig_odom)), problem.fixed), 6)]
    between = J_poses.T @ by_steps
    rig = by_steps.T @ by_steps + np.diag(problem.prior**-2)
    A = np.block([[(J_poses.T @ J_poses).toarray(), between], [between.T, rig]])
    blocks = np.zeros((len(state.points), 3, 3))
    np.add.at(blocks, seen.landmark, np.swapaxes(by_point, 1, 2) @ by_point)
    coupling = sparse.vstack([J_poses.T @ J_points, sparse.csr_matrix((J_points.T @ by_steps).T)]).tocsr()
    a = np.concatenate([J_poses.T @ error, by_steps.T @ error - state.steps / problem.prior**2])
    return _Normal(A, blocks, coupling, a, np.asarray(J_points.T @ error))


def _scattered(J: Array, index: Indices, count: int) -> sparse.csr_matrix:
    """Return the sparse Jacobian (2 M, count * D) of blocks J (M, 2, D) at the unknown of each observation."""
    M, _, D = J.shape
    columns = np.broadcast_to(D * index[:, None, None] + np.arange(D), (M, 2, D))
    rows = np.broadcast_to(np.arange(2 * M).reshape(M, 2, 1), (M, 2, D))
    return sparse.csr_matrix((J.ravel(), (rows.ravel(), columns.ravel())), (2 * M, count * D))


def _by_point(rig: Rig, camera: Indices, points: Array) -> Array:
    """Return the derivative (M, 2, 3) of the pixels by the points in the rig frame."""
    reach = STEP * np.linalg.norm(points, axis=1, keepdims=True)
    columns = [(project(rig, camera, points + reach * axis) - project(rig, camera, points - reach * axis)) / (2 * reach)
               for axis in np.eye(3)]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))


def _by_steps(problem: _Problem, state: DriveState, in_rig: Array) -> Array:
    """Return the derivative (M, 2, P) of the pixels by the rig's steps."""
    camera, at = problem.observations.camera, problem.parameters.at
    columns = [(project(at(state.steps + step), camera, in_rig) - project(at(state.steps - step), camera, in_rig))
               / (2 * STEP) for step in STEP * np.eye(len(state.steps))]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))


def _consistent(problem: _Problem, state: DriveState, sigma_px: float) -> Flags:
    """Return the observations (M,) of landmarks that behave as one point, without those that are far off."""
    seen, squared = problem.observations, (problem.residuals(state) ** 2).sum(axis=1)
    total, count = np.zeros(len(state.points)), np.zeros(len(state.points))
    np.add.at(total, seen.landmark, np.minimum(squared, 1.0))
    np.add.at(count, seen.landmark, 2)
    rms = np.sqrt(total / np.maximum(count, 1))
    firm = (rms < LOOSE_LANDMARK * sigma_px)[seen.landmark]
    return np.asarray(firm & (squared < (LOOSE_OBSERVATION * sigma_px) ** 2))
