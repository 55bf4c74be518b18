"""Bundle adjustment of one camera and the poses of a board, by Levenberg and Marquardt with a Huber kernel.

Every image has its own pose, so the normal equations are an arrow: the poses are eliminated (Schur complement) and
only a matrix of the intrinsics' size is solved (Triggs et al. 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array

MAX_STEPS = 60
# Rounds with the kernel's width measured anew.
KERNEL_ROUNDS = 3
# Of the deviation of one coordinate: a normal residual is longer once in 23 times.
HUBER = 2.5
MIN_SIGMA_PX = 0.02
# What a corner costs whose ray the model has lost: more than any that it has.
LOST_PX = 300.0
# Done when a step that was hardly damped, so that it reached along the flattest valley, saves less than this part.
STILL, UNDAMPED = 1e-9, 1e-7
# Numeric derivatives: parameters are scaled so that one unit moves the image by about a pixel; points by their depth.
STEP = 1e-4


class Projection(Protocol):
    """A camera, or several as one: pixels (N, 2) of points (N, 3), NaN where there is no image."""

    def project(self, points: Array) -> Array:
        """The pixels."""


Make = Callable[[Array], Projection]


@dataclass(frozen=True, slots=True)
class Observed:
    """Corners seen: pixels (K, N, 2) of K images, NaN where a corner is not known, of board points (N, 3) [m]."""

    pixels: Array
    points: Array

    def only(self, chosen: Array) -> Observed:
        """The images of that index or selection."""
        return replace(self, pixels=self.pixels[chosen])


@dataclass(frozen=True, slots=True)
class Adjusted:
    """What bundle adjustment found; residuals are measured minus modelled [px], NaN where nothing was measured."""

    parameters: Array  # (P,)
    T_cam_board: Array  # (K, 4, 4)
    residuals: Array  # (K, N, 2)
    covariance: Array  # (P, P)

    @property
    def errors_px(self) -> Array:
        """Length of every residual (K, N)."""
        return np.asarray(np.linalg.norm(self.residuals, axis=2))

    @property
    def mean_px(self) -> float:
        """Mean length of the residuals: OCamCalib's reprojection error."""
        return float(np.nanmean(self.errors_px))


def residuals(camera: Projection, T_cam_board: Array, observed: Observed) -> Array:
    """Measured minus modelled pixels (K, N, 2); NaN where there is no measurement, LOST_PX where there is no model."""
    cast = camera.project(se3.apply(T_cam_board, observed.points).reshape(-1, 3)).reshape(observed.pixels.shape)
    lost = np.isnan(cast) & np.isfinite(observed.pixels)
    return np.where(lost, LOST_PX, observed.pixels - cast)


def adjust(make: Make, parameters: Array, T_cam_board: Array, observed: Observed) -> Adjusted:
    """The parameters and poses of least robust reprojection error near those given."""
    state = _State(make, observed, np.asarray(parameters, float), np.asarray(T_cam_board, float))
    sigma = np.inf
    for _ in range(KERNEL_ROUNDS):
        sigma = min(sigma, _spread(state.residuals))
        state = _descend(state, HUBER * sigma)
    return _adjusted(state, HUBER * sigma)


def _spread(residual: Array) -> float:
    """Standard deviation [px] of one coordinate, by the median."""
    return max(MIN_SIGMA_PX, 1.4826 * float(np.nanmedian(np.abs(residual))))


class _State:
    """One point of the search, with its residuals."""

    __slots__ = ("make", "observed", "parameters", "poses", "residuals")

    def __init__(self, make: Make, observed: Observed, parameters: Array, poses: Array) -> None:
        self.make, self.observed, self.parameters, self.poses = make, observed, parameters, poses
        self.residuals = residuals(make(parameters), poses, observed)

    def moved(self, intrinsic: Array, pose: Array) -> _State | None:
        """The state after a step; None where no camera is that way."""
        try:
            return _State(self.make, self.observed, self.parameters + intrinsic, se3.exp(pose) @ self.poses)
        except (CalibError, np.linalg.LinAlgError):
            return None

    def cost(self, kernel_px: float) -> float:
        """Sum of Huber's function over the corners."""
        length = np.linalg.norm(self.residuals, axis=2)
        bent = np.where(length <= kernel_px, length**2, kernel_px * (2 * length - kernel_px))
        return float(np.nansum(bent))


@dataclass(frozen=True, slots=True)
class _Normal:
    """The arrow of weighted normal equations."""

    A: Array  # (P, P) intrinsics
    B: Array  # (K, P, 6) between
    C: Array  # (K, 6, 6) poses
    a: Array  # (P,)
    c: Array  # (K, 6)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Steps of the intrinsics (P,) and of the poses (K, 6)."""
        C = self.C + damping * _diagonals(self.C)
        BC = self.B @ np.linalg.inv(C)
        S = self.A + damping * np.diag(np.diag(self.A)) - (BC @ self.B.swapaxes(1, 2)).sum(axis=0)
        intrinsic = np.linalg.lstsq(S, self.a - (BC @ self.c[..., None]).sum(axis=0)[:, 0], rcond=1e-15)[0]
        pose = np.linalg.solve(C, (self.c - intrinsic @ self.B)[..., None])[..., 0]
        return intrinsic, pose

    def covariance(self) -> Array:
        """Inverse (P, P) of the reduced system, for residuals of deviation 1."""
        reduced = self.A - (self.B @ np.linalg.inv(self.C) @ self.B.swapaxes(1, 2)).sum(axis=0)
        return np.asarray(np.linalg.pinv(reduced, rcond=1e-14, hermitian=True))


def _diagonals(C: Array) -> Array:
    return np.asarray(C * np.eye(C.shape[-1]) + 1e-12 * np.eye(C.shape[-1]))


def _descend(state: _State, kernel_px: float) -> _State:
    damping, cost = 1e-4, state.cost(kernel_px)
    normal = _normal(state, kernel_px)
    for _ in range(MAX_STEPS):
        trial = state.moved(*normal.step(damping))
        new_cost = trial.cost(kernel_px) if trial is not None else np.inf
        if trial is None or not new_cost < cost:
            damping *= 8
            if damping > 1e8:
                break
            continue
        state, saved, cost = trial, cost - new_cost, new_cost
        if saved < STILL * cost and damping < UNDAMPED:
            break
        damping = max(1e-9, damping / 10)
        normal = _normal(state, kernel_px)
    return state


def _normal(state: _State, kernel_px: float) -> _Normal:
    residual, weight = _weighed(state.residuals, kernel_px)
    J_in, J_pose = _jacobians(state)
    K = len(residual)
    root = np.sqrt(weight)[..., None, None]
    J_in, J_pose = ((root * J).reshape(K, -1, J.shape[-1]) for J in (J_in, J_pose))
    r = (root[..., 0] * residual).reshape(K, -1)
    return _Normal(np.einsum("kri,krj->ij", J_in, J_in), J_in.swapaxes(1, 2) @ J_pose, J_pose.swapaxes(1, 2) @ J_pose,
                   np.einsum("kri,kr->i", J_in, r), np.einsum("kri,kr->ki", J_pose, r))


def _weighed(residual: Array, kernel_px: float) -> tuple[Array, Array]:
    """Residuals with 0 for what is missing, and Huber's weights (K, N)."""
    length = np.linalg.norm(residual, axis=2)
    weight = np.where(np.isfinite(length), np.minimum(1.0, kernel_px / np.maximum(length, 1e-12)), 0.0)
    return np.nan_to_num(residual), weight


def _jacobians(state: _State) -> tuple[Array, Array]:
    """Derivatives of the modelled pixels by parameters (K, N, 2, P) and by left motions of the poses (K, N, 2, 6)."""
    points = se3.apply(state.poses, state.observed.points)
    flat = points.reshape(-1, 3)
    columns = []
    for step in STEP * np.eye(len(state.parameters)):
        ahead, behind = (state.make(state.parameters + sign * step).project(flat) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    by_parameter = np.nan_to_num(np.stack(columns, axis=-1))
    by_point = _by_point(state.make(state.parameters), flat)
    by_pose = np.concatenate([by_point, -by_point @ se3.hat(flat)], axis=-1)
    shape = points.shape[:2]
    return by_parameter.reshape(*shape, 2, -1), by_pose.reshape(*shape, 2, 6)


def _by_point(camera: Projection, points: Array) -> Array:
    """Derivative (N, 2, 3) of the pixels by the points."""
    reach = STEP * np.linalg.norm(points, axis=1, keepdims=True)
    columns = [(camera.project(points + reach * axis) - camera.project(points - reach * axis)) / (2 * reach)
               for axis in np.eye(3)]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))


def _adjusted(state: _State, kernel_px: float) -> Adjusted:
    residual, weight = _weighed(state.residuals, kernel_px)
    freedom = 2 * float(weight.sum()) - state.parameters.size - 6 * len(residual)
    variance = float((weight[..., None] * residual**2).sum()) / max(freedom, 1.0)
    covariance = variance * _normal(state, kernel_px).covariance()
    return Adjusted(state.parameters, state.poses, state.residuals, covariance)
