"""The least-squares problem of a drive: poses and the rig are common unknowns, each landmark is a block of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from calib import se3
from calib.errors import CalibError
from calib.fit.drive.observations import DriveObservations, DriveState, Indices, project
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.least_squares import ArrowSystem
from calib.fit.robust_scale import LOST_PX, robust_sigma
from calib.models.camera import Array

# Step of numeric derivatives, in steps of a parameter (about a pixel each) or in parts of a point's distance: a model
# is linear over a ten-thousandth of a pixel, and rounding is 1e-9 of it.
STEP = 1e-4
# Cauchy's function counts errors of more sigmas less, so that one of 3 sigmas has half of the weight.
KERNEL = 3.0


@dataclass(frozen=True, slots=True)
class _Jacobians:
    """Weighted residuals (2 M,) and their derivatives."""

    error: Array  # (2 M,)
    by_pose: scipy.sparse.csr_matrix  # (2 M, 6 F) by twists of the free keyframes
    by_steps: Array  # (2 M, P)
    of_landmarks: Array  # (M, 2, 3) of each observation by its landmark


@dataclass(frozen=True, slots=True)
class DriveProblem:
    """The robust reprojection error of landmarks, and the prior of the rig: what an adjustment of a drive minimises."""

    parameters: RigParameters
    observations: DriveObservations
    prior: Array  # (P, P) information of the steps, about zero
    fixed: Indices  # keyframes whose pose stays

    def residuals(self, state: DriveState) -> Array:
        """Return measured minus modelled pixels (M, 2); LOST_PX where the model has no image."""
        seen = self.observations
        cast = self.caster(state.steps, seen.camera)(self.in_rig(state, state.steps))
        return np.where(np.isfinite(cast), seen.pixels - cast, LOST_PX)

    def caster(self, steps: Array, camera: Indices) -> Callable[[Array], Array]:
        """Return the projection of points (M, 3) in the rig frame to pixels (M, 2), after steps (P,)."""
        rig, waves = self.parameters.at(steps), self.parameters.wavefronts_at(steps)
        return lambda points: project(rig, camera, points, waves)

    def in_rig(self, state: DriveState, steps: Array) -> Array:
        """Return the landmark (M, 3) of each observation in the rig frame at the time of its exposure."""
        seen = self.observations
        T = state.T_rig_odom[seen.keyframe]
        points = (T[:, :3, :3] @ state.points[seen.landmark][:, :, None])[:, :, 0] + T[:, :3, 3]
        delay_s = self._delay_s(state, steps)
        if not np.any(delay_s):
            return np.asarray(points)
        # p(t) = exp(-t xi) p, to second order in t.
        twist = state.motion.twist[seen.keyframe]
        first = -delay_s[:, None] * (twist[:, :3] + np.cross(twist[:, 3:], points))
        return np.asarray(points + first - delay_s[:, None] / 2 * np.cross(twist[:, 3:], first))

    def _delay_s(self, state: DriveState, steps: Array) -> Array:
        """Return the time (M,) [s] of each observation's exposure after its keyframe's stamp."""
        seen, times = self.observations, self.parameters.times_at(steps)
        upper = np.where(seen.camera == 1, state.motion.upper_delay_s[seen.keyframe] + times.upper_delay_s, 0.0)
        return np.asarray(upper + times.line_time_s * seen.pixels[:, 1])

    def cost(self, state: DriveState, sigma_px: float) -> float:
        """Return the sum of Cauchy's function over the observations, and the prior's."""
        squared = (self.residuals(state) ** 2).sum(axis=1) / sigma_px**2
        return float(KERNEL**2 * np.log1p(squared / KERNEL**2).sum() + state.steps @ self.prior @ state.steps)

    def scale(self, state: DriveState) -> float:
        """Return the standard deviation [px] of one coordinate, by the median."""
        return robust_sigma(self.residuals(state))

    def moved(self, state: DriveState, common: Array, blocks: Array) -> DriveState | None:
        """Return the state after steps of poses and rig (C,) and of landmarks (L, 3); None without such a camera."""
        P = len(self.prior)
        T = state.T_rig_odom.copy()
        free = np.setdiff1d(np.arange(len(T)), self.fixed)
        T[free] = se3.exp(common[:-P].reshape(-1, 6)) @ T[free]
        moved = replace(state, T_rig_odom=T, points=state.points + blocks, steps=state.steps + common[-P:])
        try:
            self.parameters.at(moved.steps)
        except CalibError:
            return None
        return moved

    def normal_equations(self, state: DriveState, scale: float) -> ArrowSystem:
        """Return the normal equations of poses and rig, with one block for each landmark."""
        J, seen = self._jacobians(state, scale), self.observations
        between = J.by_pose.T @ J.by_steps
        A = np.block(
            [[(J.by_pose.T @ J.by_pose).toarray(), between], [between.T, J.by_steps.T @ J.by_steps + self.prior]]
        )
        blocks = np.zeros((len(state.points), 3, 3))
        np.add.at(blocks, seen.landmark, np.swapaxes(J.of_landmarks, 1, 2) @ J.of_landmarks)
        by_point = _scattered(J.of_landmarks, seen.landmark, len(state.points))
        coupling = scipy.sparse.vstack(
            [J.by_pose.T @ by_point, scipy.sparse.csr_matrix((by_point.T @ J.by_steps).T)]
        ).tocsr()
        a = np.concatenate([J.by_pose.T @ J.error, J.by_steps.T @ J.error - self.prior @ state.steps])
        return ArrowSystem(A, coupling, blocks, a, np.asarray(by_point.T @ J.error))

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
        J, count = self._jacobians(state, scale), len(state.points)
        of_landmark = np.repeat(self.observations.landmark, 2)
        errors = scipy.sparse.csr_matrix((J.error, (np.arange(len(J.error)), of_landmark)), (len(J.error), count))
        own = scipy.sparse.csr_matrix(
            (system.c, (np.arange(3 * count), np.repeat(np.arange(count), 3))), (3 * count, count)
        )
        shares = np.concatenate([(J.by_pose.T @ errors).toarray(), (errors.T @ J.by_steps).T])
        shares = shares - (system.B @ system.inverse_blocks() @ own).toarray()
        # 3. The variance of the gradient between the two inverses.
        P = len(prior)
        known = np.zeros_like(inverse)
        known[-P:, -P:] = prior
        return np.asarray((inverse @ (shares @ shares.T + known) @ inverse)[-P:, -P:])

    def _jacobians(self, state: DriveState, scale: float) -> _Jacobians:
        """Return derivatives and residuals in sigmas, with the weights of Cauchy's function."""
        seen, residual = self.observations, self.residuals(state)
        squared = (residual**2).sum(axis=1) / scale**2
        root = np.sqrt(1 / (1 + squared / KERNEL**2))[:, None] / scale
        in_rig = self.in_rig(state, state.steps)
        by_rig_point = self._by_point(state.steps, in_rig) * root[:, :, None]
        by_pose = np.concatenate([by_rig_point, -by_rig_point @ se3.hat(in_rig)], axis=2)
        by_steps = (self._by_steps(state) * root[:, :, None]).reshape(-1, len(self.prior))
        J_poses = _scattered(by_pose, seen.keyframe, len(state.T_rig_odom))
        is_free = np.repeat(~np.isin(np.arange(len(state.T_rig_odom)), self.fixed), 6)
        return _Jacobians(
            (residual * root).ravel(),
            J_poses[:, is_free],
            by_steps,
            by_rig_point @ state.T_rig_odom[seen.keyframe][:, :3, :3],
        )

    def _by_point(self, steps: Array, points: Array) -> Array:
        """Return the derivative (M, 2, 3) of the pixels by the points in the rig frame."""
        cast, reach = self.caster(steps, self.observations.camera), STEP * np.linalg.norm(points, axis=1, keepdims=True)
        columns = [(cast(points + reach * axis) - cast(points - reach * axis)) / (2 * reach) for axis in np.eye(3)]
        return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))

    def _by_steps(self, state: DriveState) -> Array:
        """Return the derivative (M, 2, P) of the pixels by the rig's steps."""
        parameters, camera = self.parameters, self.observations.camera
        J = np.zeros((len(camera), 2, len(state.steps)))
        in_rig = self.in_rig(state, state.steps)
        for k, step in enumerate(STEP * np.eye(len(state.steps))):
            moved = [side for side in (0, 1) if parameters.moves_camera(side)[k]]
            at, is_time = np.flatnonzero(np.isin(camera, moved)), parameters.names[k] in parameters.times
            ahead, behind = (
                self.caster(steps, camera[at])(self.in_rig(state, steps)[at] if is_time else in_rig[at])
                for steps in (state.steps + step, state.steps - step)
            )
            J[at, :, k] = np.nan_to_num((ahead - behind) / (2 * STEP))
        return J


def _scattered(J: Array, index: Indices, count: int) -> scipy.sparse.csr_matrix:
    """Return the sparse Jacobian (2 M, count * D) of blocks J (M, 2, D) at the unknown of each observation."""
    M, _, D = J.shape
    columns = np.broadcast_to(D * index[:, None, None] + np.arange(D), (M, 2, D))
    rows = np.broadcast_to(np.arange(2 * M).reshape(M, 2, 1), (M, 2, D))
    return scipy.sparse.csr_matrix((J.ravel(), (rows.ravel(), columns.ravel())), (2 * M, count * D))
