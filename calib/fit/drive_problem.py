"""Observations of a drive, their residuals, and the normal equations of poses, landmarks and rig.

Landmarks are eliminated from the normal equations (Schur complement; Triggs et al. 2000, section 6), so that a dense
system of the size of keyframes and rig is solved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calib import se3
from calib.fit.drive_parameters import RigParameters
from calib.models import wavefront as wavefronts
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import DISTANCE_M, OcamCamera
from calib.rig import Rig

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

STEP = 1e-4  # of numeric derivatives, in steps of a parameter (about a pixel each) or in parts of a point's distance
KERNEL = 3.0  # sigmas at which Cauchy's kernel begins to count an error less
LOST_PX = 50.0  # error of an observation whose point the model does not project


@dataclass(frozen=True, slots=True)
class KeyframeMotion:
    """Motion of the rig at each keyframe, by which an exposure at another time is predicted."""

    twist: Array  # (K, 6) [m/s, rad/s] of the rig, in its own frame
    upper_delay_s: Array  # (K,) upper stamp minus lower stamp

    @staticmethod
    def still(keyframes: int) -> KeyframeMotion:
        """Return the motion of keyframes whose images show one instant."""
        return KeyframeMotion(np.zeros((keyframes, 6)), np.zeros(keyframes))


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
    """Poses of the keyframes at the lower camera's stamps, landmarks in odom, steps of the rig's parameters."""

    T_rig_odom: Array  # (K, 4, 4)
    points: Array  # (L, 3) m
    steps: Array  # (P,)
    motion: KeyframeMotion


def project(rig: Rig, camera: Indices, points: Array, waves: Array | None = None) -> Array:
    """Return pixels (M, 2) of points (M, 3) in the rig frame, each in its camera; NaN where there is no image.

    waves: wavefronts (2, 5) [m] of both cameras, None: central cameras. The cameras themselves are exact at DISTANCE_M.
    """
    pixels = np.full((len(points), 2), np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        at = np.flatnonzero(camera == side)
        if len(at):
            seen = se3.apply(mounted.T_cam_rig, points[at])
            if waves is not None and np.any(waves[side]):
                seen = _at_distance(mounted.camera, seen, tuple(waves[side].tolist()))
            pixels[at] = mounted.camera.project(seen)
    return pixels


def _at_distance(camera: OmniCamera, points: Array, wavefront: tuple[float, ...]) -> Array:
    """Return the places (N, 3), at the distance for which a camera is exact, of the rays to points (N, 3) [m]."""
    axis = float(np.sign(camera.lift(np.array([camera.center]))[0, 2]))
    distance_m = camera.distance_m if isinstance(camera, OcamCamera) else DISTANCE_M
    return wavefronts.points_at(distance_m, wavefronts.directions_to(points, wavefront, axis), wavefront, axis)


@dataclass(frozen=True, slots=True)
class DriveProblem:
    """All that stays the same while the search goes on."""

    parameters: RigParameters
    observations: DriveObservations
    prior: Array  # (P, P) information of the steps, about zero
    fixed: Indices  # keyframes whose pose stays
    held: bool = False  # True: the rig stays at the state's steps

    def residuals(self, state: DriveState) -> Array:
        """Return measured minus modelled pixels (M, 2); LOST_PX where the model has no image."""
        seen = self.observations
        cast = self.cast(state.steps, seen.camera, self.in_rig(state, state.steps))
        return np.where(np.isfinite(cast), seen.pixels - cast, LOST_PX)

    def cast(self, steps: Array, camera: Indices, points: Array) -> Array:
        """Return pixels (M, 2) of points (M, 3) in the rig frame after steps (P,) of the parameters."""
        return project(self.parameters.at(steps), camera, points, self.parameters.wavefronts_at(steps))

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
        known = 0.0 if self.held else float(state.steps @ self.prior @ state.steps)
        return float(KERNEL**2 * np.log1p(squared / KERNEL**2).sum()) + known


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Weighted normal equations: frames and rig (C), landmarks (3 x 3 blocks), and what couples them (C, 3 L)."""

    A: Array
    blocks: Array  # (L, 3, 3)
    coupling: sparse.csr_matrix
    a: Array
    b: Array  # (3 L,)
    by_landmark: Array  # (C, L) share of each landmark in a: its observations' errors

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of frames and rig (C,) and of the landmarks (L, 3)."""
        inverse = self._inverse(damping)
        between = self.coupling @ inverse
        reduced = self.A + damping * np.diag(np.diag(self.A)) - (between @ self.coupling.T).toarray()
        step = np.linalg.solve(reduced, self.a - between @ self.b)
        return step, np.asarray(inverse @ (self.b - self.coupling.T @ step)).reshape(-1, 3)

    def covariance(self, prior: Array) -> Array:
        """Return the covariance (P, P) of the rig, to whose gradient the prior adds the variance (P, P).

        Errors of one landmark's observations depend on each other: its patch, its surface and its slope are the same
        in all of them. So the variance of the gradient is that of the landmarks' sums (sandwich estimator with
        clusters; Liang and Zeger 1986).
        """
        inverse = np.linalg.inv(self.A - (self.coupling @ self._inverse(0.0) @ self.coupling.T).toarray())
        P = len(prior)
        known = np.zeros_like(inverse)
        known[-P:, -P:] = prior
        of_gradient = self._eliminated()
        return np.asarray((inverse @ (of_gradient @ of_gradient.T + known) @ inverse)[-P:, -P:])

    def _eliminated(self) -> Array:
        """Return each landmark's share (C, L) in the reduced gradient."""
        count = len(self.blocks)
        columns = sparse.csr_matrix((self.b, (np.arange(3 * count), np.repeat(np.arange(count), 3))),
                                    (3 * count, count))
        return np.asarray(self.by_landmark - (self.coupling @ self._inverse(0.0) @ columns).toarray())

    def _inverse(self, damping: float) -> sparse.csr_matrix:
        count = len(self.blocks)
        damped = self.blocks * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3)
        return sparse.bsr_matrix((np.linalg.inv(damped), np.arange(count), np.arange(count + 1)),
                                 (3 * count, 3 * count)).tocsr()


def linearise(problem: DriveProblem, state: DriveState, sigma_px: float) -> NormalEquations:
    """Return the normal equations at a state, of residuals in sigmas with Cauchy's weights."""
    seen, residual = problem.observations, problem.residuals(state)
    squared = (residual**2).sum(axis=1) / sigma_px**2
    root = np.sqrt(1 / (1 + squared / KERNEL**2))[:, None] / sigma_px
    in_rig = problem.in_rig(state, state.steps)
    by_rig_point = _by_point(problem, state.steps, in_rig) * root[:, :, None]
    by_point = by_rig_point @ state.T_rig_odom[seen.keyframe][:, :3, :3]
    by_pose = np.concatenate([by_rig_point, -by_rig_point @ se3.hat(in_rig)], axis=2)
    by_steps = (_by_steps(problem, state) * root[:, :, None]).reshape(-1, len(problem.prior))
    error = (residual * root).ravel()
    J_points = _scattered(by_point, seen.landmark, len(state.points))
    J_poses = _scattered(by_pose, seen.keyframe, len(state.T_rig_odom))
    J_poses = J_poses[:, np.repeat(~np.isin(np.arange(len(state.T_rig_odom)), problem.fixed), 6)]
    between = J_poses.T @ by_steps
    A = np.block([[(J_poses.T @ J_poses).toarray(), between], [between.T, by_steps.T @ by_steps + problem.prior]])
    blocks = np.zeros((len(state.points), 3, 3))
    np.add.at(blocks, seen.landmark, np.swapaxes(by_point, 1, 2) @ by_point)
    coupling = sparse.vstack([J_poses.T @ J_points, sparse.csr_matrix((J_points.T @ by_steps).T)]).tocsr()
    known = np.zeros(len(state.steps)) if problem.held else problem.prior @ state.steps
    a = np.concatenate([J_poses.T @ error, by_steps.T @ error - known])
    errors = sparse.csr_matrix((error, (np.arange(len(error)), np.repeat(seen.landmark, 2))),
                               (len(error), len(state.points)))
    by_landmark = np.concatenate([(J_poses.T @ errors).toarray(), (errors.T @ by_steps).T])
    return NormalEquations(A, blocks, coupling, a, np.asarray(J_points.T @ error), by_landmark)


def _scattered(J: Array, index: Indices, count: int) -> sparse.csr_matrix:
    """Return the sparse Jacobian (2 M, count * D) of blocks J (M, 2, D) at the unknown of each observation."""
    M, _, D = J.shape
    columns = np.broadcast_to(D * index[:, None, None] + np.arange(D), (M, 2, D))
    rows = np.broadcast_to(np.arange(2 * M).reshape(M, 2, 1), (M, 2, D))
    return sparse.csr_matrix((J.ravel(), (rows.ravel(), columns.ravel())), (2 * M, count * D))


def _by_point(problem: DriveProblem, steps: Array, points: Array) -> Array:
    """Return the derivative (M, 2, 3) of the pixels by the points in the rig frame."""
    camera, reach = problem.observations.camera, STEP * np.linalg.norm(points, axis=1, keepdims=True)
    columns = [(problem.cast(steps, camera, points + reach * axis) - problem.cast(steps, camera, points - reach * axis))
               / (2 * reach) for axis in np.eye(3)]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))


def _by_steps(problem: DriveProblem, state: DriveState) -> Array:
    """Return the derivative (M, 2, P) of the pixels by the rig's steps."""
    parameters, camera = problem.parameters, problem.observations.camera
    J = np.zeros((len(camera), 2, len(state.steps)))
    if problem.held:
        return J
    in_rig = problem.in_rig(state, state.steps)
    for k, step in enumerate(STEP * np.eye(len(state.steps))):
        moved = [side for side in (0, 1) if parameters.moves_camera(side)[k]]
        at, is_time = np.flatnonzero(np.isin(camera, moved)), parameters.names[k] in parameters.times
        ahead, behind = (problem.cast(steps, camera[at], problem.in_rig(state, steps)[at] if is_time else in_rig[at])
                         for steps in (state.steps + step, state.steps - step))
        J[at, :, k] = np.nan_to_num((ahead - behind) / (2 * STEP))
    return J
