"""Bundle adjustment of a rig from a drive: poses of keyframes, landmarks, both cameras and the transform between them.

What a drive shows of a rig: the centre of each camera and the tilt between them, from the columns; the mapping from
radius to elevation, because the same landmark is seen from near and from far. A stretch of that mapping along the
baseline cannot be distinguished from a stretched world as long as the rig moves in one plane and does not tilt; only
the form of the camera model and the prior hold it. The baseline keeps its length, for images alone do not show it.

Poses and the rig are common unknowns of the least-squares problem; each landmark is a block of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from calib import se3
from calib.errors import CalibError
from calib.fit.least_squares import (
    BEST_STEP,
    KERNEL_WIDTH,
    ROUNDS,
    ArrowSystem,
    central_differences,
    minimise,
    robust_sigma,
)
from calib.fit.parameters import LINE_TIME, RigParameters
from calib.models.camera import Array
from calib.models.ocam import project_near
from calib.rig import Rig

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]
# Patches are matched to a tenth of a pixel, so that observations that fit no better than to a pixel show no rigid
# world.
MAX_SIGMA_PX = 1.0
# A search ends where a step reduces the cost by less than a share of it: the rough one while landmarks are still
# selected, because the search goes on with the next selection, the fine one at the end.
ROUGH_GAIN, FINE_GAIN = 1e-3, 1e-6
# Observations that count as one corner of a calibration by boards: errors of a patch are correlated in both cameras and
# from keyframe to keyframe (0.9 in rendered rooms).
CORRELATED_OBSERVATIONS = 10.0


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
    """Poses of the keyframes at the lower camera's stamps, landmarks in odom, steps of the rig's parameters.

    The motion at each keyframe predicts an exposure at another time.
    """

    T_rig_odom: Array  # (K, 4, 4)
    points: Array  # (L, 3) m
    twist: Array  # (K, 6) [m/s, rad/s] of the rig, in its own frame
    upper_delay_s: Array  # (K,) upper stamp minus lower stamp
    steps: Array  # (P,)


@dataclass(frozen=True, slots=True)
class DriveAdjustment:
    """The rig that fits a drive, and how well."""

    parameters: RigParameters
    state: DriveState
    observations: DriveObservations  # those that were used
    covariance: Array  # (P, P) of the steps
    sigma_px: float  # of one coordinate of an observation

    @property
    def rig(self) -> Rig:
        """The adjusted rig."""
        return self.parameters.at(self.state.steps)


def adjust_drive(
    parameters: RigParameters,
    state: DriveState,
    observations: DriveObservations,
    *,
    correlated: float = 1.0,
) -> DriveAdjustment:
    """Return the rig, poses and landmarks of least robust reprojection error near those given.

    correlated: number of observations that count as one independent one; the weight of the prior of the parameters is
    multiplied by it. CalibError where fewer landmarks agree than the rig has parameters.
    """
    prior = parameters.prior()
    problem = DriveProblem(parameters, observations, correlated * prior)
    state, sigma_px = problem.minimised(state, ROUGH_GAIN)
    # Loose landmarks are left out in several rounds, because the rig moves without them, and others become loose.
    for number in range(ROUNDS):
        kept, used = observations.only(problem.consistent(state, sigma_px))
        if sigma_px > MAX_SIGMA_PX:
            raise CalibError(
                f"calibrate drive: the landmarks are {sigma_px:.1f} px off any rig and path, expected "
                f"{MAX_SIGMA_PX:.0f} px at most; is the rig that of these cameras?"
            )
        if len(used) < len(prior):
            raise CalibError(
                f"calibrate drive: only {len(used)} landmarks agree with a rigid world, {len(prior)} "
                "are needed; is the rig that of these cameras, is there enough to see?"
            )
        observations, state = kept, replace(state, points=state.points[used])
        problem = replace(problem, observations=observations)
        state, sigma_px = problem.minimised(state, FINE_GAIN if number == ROUNDS - 1 else ROUGH_GAIN)
    covariance = problem.covariance(state, sigma_px, correlated**2 * prior)
    return DriveAdjustment(parameters, state, observations, covariance, sigma_px)


def observation_sigma(rig: Rig, found: DriveAdjustment) -> float:
    """Return the sigma [px] of one coordinate with another rig, which stays; poses and landmarks are adjusted."""
    problem = DriveProblem(RigParameters(rig, ()), found.observations, np.zeros((0, 0)))
    return problem.minimised(replace(found.state, steps=np.zeros(0)), ROUGH_GAIN)[1]


def project(rig: Rig, camera: Indices, points: Array) -> Array:
    """Return pixels (M, 2) of points (M, 3) [m] in the rig frame, each in its camera; NaN where there is no image."""
    pixels = np.full((len(points), 2), np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        pixels[camera == side] = project_near(mounted.camera, se3.apply(mounted.T_cam_rig, points[camera == side]))
    return pixels


# Weighted residuals (2 M,), and their derivatives (2 M, 6 F) by twists of the free keyframes, (2 M, P) by the steps of
# the rig, and (M, 2, 3) of each observation by its landmark.
Jacobians: TypeAlias = tuple[Array, scipy.sparse.csr_matrix, Array, Array]


@dataclass(frozen=True, slots=True)
class DriveProblem:
    """The robust reprojection error of landmarks, and the prior of the rig: what an adjustment of a drive minimises.

    The pose of the first keyframe stays.
    """

    parameters: RigParameters
    observations: DriveObservations
    prior: Array  # (P, P) information of the steps, about zero

    def minimised(self, state: DriveState, gain: float) -> tuple[DriveState, float]:
        """Return the state of least cost, and the standard deviation [px] of one coordinate there."""
        found = minimise(self, state, gain)
        return found, self.scale(found)

    def consistent(self, state: DriveState, sigma_px: float) -> Flags:
        """Return True (M,) for observations that are not far off, of landmarks that behave as one point."""
        landmark, squared = self.observations.landmark, (self.residuals(state) ** 2).sum(axis=1)
        total = np.bincount(landmark, np.minimum(squared, 1.0), len(state.points))
        rms = np.sqrt(total / np.maximum(2 * np.bincount(landmark, minlength=len(state.points)), 1))
        # A landmark is not one point of one surface if the RMS of its errors exceeds the width of the kernel, an
        # observation is a wrong match beyond twice of it. The kernel alone would leave them some weight.
        firm = (rms < KERNEL_WIDTH * sigma_px)[landmark]
        return np.asarray(firm & (squared < (2 * KERNEL_WIDTH * sigma_px) ** 2))

    def residuals(self, state: DriveState) -> Array:
        """Return measured minus modelled pixels (M, 2); the image's diagonal where the model has no image."""
        seen = self.observations
        cast = project(self.parameters.at(state.steps), seen.camera, self.in_rig(state, state.steps))
        return np.where(np.isfinite(cast), seen.pixels - cast, np.hypot(*self.parameters.rig.lower.camera.size))

    def in_rig(self, state: DriveState, steps: Array) -> Array:
        """Return the landmark (M, 3) of each observation in the rig frame at the time of its exposure."""
        seen, times = self.observations, self.parameters.times_at(steps)
        T = state.T_rig_odom[seen.keyframe]
        points = (se3.R_of(T) @ state.points[seen.landmark][:, :, None])[:, :, 0] + se3.t_of(T)
        upper = np.where(seen.camera == 1, state.upper_delay_s[seen.keyframe] + times.upper_delay_s, 0.0)
        delay_s = (upper + times.line_time_s * seen.pixels[:, 1])[:, None]
        # p(t) = exp(-t xi) p, to second order in t.
        twist = state.twist[seen.keyframe]
        first = -delay_s * (twist[:, :3] + np.cross(twist[:, 3:], points))
        return np.asarray(points + first - delay_s / 2 * np.cross(twist[:, 3:], first))

    def cost(self, state: DriveState, scale: float) -> float:
        """Return the sum of Cauchy's function over the observations, and the prior's."""
        squared = (self.residuals(state) ** 2).sum(axis=1) / scale**2
        return float(
            KERNEL_WIDTH**2 * np.log1p(squared / KERNEL_WIDTH**2).sum() + state.steps @ self.prior @ state.steps
        )

    def scale(self, state: DriveState) -> float:
        """Return the standard deviation [px] of one coordinate, by the median."""
        return robust_sigma(self.residuals(state))

    def moved(self, state: DriveState, common: Array, blocks: Array) -> DriveState | None:
        """Return the state after steps of poses and rig (C,) and of landmarks (L, 3); None without such a camera."""
        of_poses, of_rig = np.split(common, [len(common) - len(self.prior)])
        T = state.T_rig_odom.copy()
        T[1:] = se3.exp(of_poses.reshape(-1, 6)) @ T[1:]
        moved = replace(state, T_rig_odom=T, points=state.points + blocks, steps=state.steps + of_rig)
        try:
            self.parameters.at(moved.steps)
        except CalibError:
            return None
        return moved

    def normal_equations(self, state: DriveState, scale: float) -> ArrowSystem:
        """Return the normal equations of poses and rig, with one block for each landmark."""
        error, by_pose, by_steps, of_landmarks = self._jacobians(state, scale)
        landmark, between = self.observations.landmark, by_pose.T @ by_steps
        A = np.block([[(by_pose.T @ by_pose).toarray(), between], [between.T, by_steps.T @ by_steps + self.prior]])
        # A keyframe of which no landmark is left stays where it is.
        A += np.diag(np.diag(A) == 0)
        blocks = np.zeros((len(state.points), 3, 3))
        np.add.at(blocks, landmark, np.swapaxes(of_landmarks, 1, 2) @ of_landmarks)
        by_point = _scattered(of_landmarks, landmark, len(state.points))
        coupling = scipy.sparse.vstack([by_pose.T @ by_point, scipy.sparse.csr_matrix((by_point.T @ by_steps).T)])
        a = np.concatenate([by_pose.T @ error, by_steps.T @ error - self.prior @ state.steps])
        return ArrowSystem(A, coupling.tocsr(), blocks, a, np.asarray(by_point.T @ error))

    def covariance(self, state: DriveState, scale: float, prior: Array) -> Array:
        """Return the covariance (P, P) of the rig's steps, to whose gradient the prior adds the variance (P, P).

        Errors of one landmark's observations depend on each other: its patch, its surface and its slope are the same
        in all of them. So the variance of the gradient is that of the landmarks' sums (sandwich estimator with
        clusters; Liang and Zeger 1986).
        """
        # 1. The inverse of the rig's information, landmarks eliminated.
        system = self.normal_equations(state, scale)
        inverse = np.linalg.inv(system.reduced()[0])
        # 2. Each landmark's share (C, L) in the gradient, the landmark itself eliminated.
        (error, by_pose, by_steps, _), count = self._jacobians(state, scale), len(state.points)
        of_landmark = np.repeat(self.observations.landmark, 2)
        errors = scipy.sparse.csr_matrix((error, (np.arange(len(error)), of_landmark)), (len(error), count))
        own = scipy.sparse.csr_matrix(
            (system.c, (np.arange(3 * count), np.repeat(np.arange(count), 3))), (3 * count, count)
        )
        shares = np.concatenate([(by_pose.T @ errors).toarray(), (errors.T @ by_steps).T])
        shares = shares - (system.B @ system.inverse_blocks() @ own).toarray()
        # 3. The variance of the gradient between the two inverses.
        P = len(prior)
        known = np.zeros_like(inverse)
        known[-P:, -P:] = prior
        return np.asarray((inverse @ (shares @ shares.T + known) @ inverse)[-P:, -P:])

    def _jacobians(self, state: DriveState, scale: float) -> Jacobians:
        """Return derivatives and residuals in sigmas, with the weights of Cauchy's function."""
        seen, residual = self.observations, self.residuals(state)
        squared = (residual**2).sum(axis=1) / scale**2
        root = np.sqrt(1 / (1 + squared / KERNEL_WIDTH**2))[:, None] / scale
        in_rig = self.in_rig(state, state.steps)
        # 1. By the points in the rig frame (M, 2, 3); steps are a fraction of their distance.
        rig, reach = self.parameters.at(state.steps), BEST_STEP * np.linalg.norm(in_rig, axis=1, keepdims=True)
        J = central_differences(lambda by: project(rig, seen.camera, in_rig + reach * by), np.ones(3))
        by_rig_point = np.nan_to_num(J / reach[:, :, None]) * root[:, :, None]
        # 2. By the unknowns.
        by_pose = np.concatenate([by_rig_point, -by_rig_point @ se3.hat(in_rig)], axis=2)
        by_steps = (self._by_steps(state) * root[:, :, None]).reshape(residual.size, len(self.prior))
        J_poses = _scattered(by_pose, seen.keyframe, len(state.T_rig_odom))
        of_landmarks = by_rig_point @ se3.R_of(state.T_rig_odom[seen.keyframe])
        return (residual * root).ravel(), J_poses[:, 6:], by_steps, of_landmarks

    def _by_steps(self, state: DriveState) -> Array:
        """Return the derivative (M, 2, P) of the pixels by the rig's steps."""
        parameters, camera = self.parameters, self.observations.camera
        J = np.zeros((len(camera), 2, len(state.steps)))
        in_rig = self.in_rig(state, state.steps)
        for k, step in enumerate(BEST_STEP * np.eye(len(state.steps))):
            name = parameters.names[k]
            at = (camera == (0 if name.startswith("lower ") else 1)) | (name == LINE_TIME)
            is_time = name in parameters.times
            ahead, behind = (
                project(parameters.at(steps), camera[at], (self.in_rig(state, steps) if is_time else in_rig)[at])
                for steps in (state.steps + step, state.steps - step)
            )
            J[at, :, k] = np.nan_to_num((ahead - behind) / (2 * BEST_STEP))
        return J


def _scattered(J: Array, index: Indices, count: int) -> scipy.sparse.csr_matrix:
    """Return the sparse Jacobian (2 M, count * D) of blocks J (M, 2, D) at the unknown of each observation."""
    M, _, D = J.shape
    columns = np.broadcast_to(D * index[:, None, None] + np.arange(D), (M, 2, D))
    rows = np.broadcast_to(np.arange(2 * M).reshape(M, 2, 1), (M, 2, D))
    return scipy.sparse.csr_matrix((J.ravel(), (rows.ravel(), columns.ravel())), (2 * M, count * D))
