"""Bundle adjustment of one camera and the poses of a board, by Levenberg and Marquardt with a Huber kernel.

Every image has its own pose, so the normal equations have arrow structure: the poses are eliminated (Schur complement)
and only a system of the intrinsics' size is solved (Triggs et al. 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.fit.smooth_misfit import covariance_with_misfit, smooth_fields
from calib.models.camera import Array

MAX_STEPS = 60
# Number of optimisations, each with the kernel's width estimated again.
KERNEL_ROUNDS = 3
# Width of Huber's kernel in standard deviations of one coordinate: 1 of 23 normal residuals (2-D) is longer.
HUBER_WIDTH = 2.5
# Least standard deviation assumed for a coordinate: exact corners would make the kernel's width 0.
MIN_SIGMA_PX = 0.02
# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
SIGMA_PER_MAD = 1.4826
# Residual of a corner that the model cannot project: larger than any residual of a corner in the image.
LOST_PX = 300.0
# Levenberg-Marquardt damping: start, factors after a rejected and an accepted step, limits.
START_DAMPING, DAMPING_UP, DAMPING_DOWN = 1e-4, 8, 10
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e8
# Converged: a step with damping below CONVERGED_DAMPING, so that it follows the flattest direction of the cost as well,
# lowers the cost by less than this part.
CONVERGED_PART, CONVERGED_DAMPING = 1e-9, 1e-7
# Added to the diagonal of a pose's block, so that a pose without corners stays invertible.
POSE_REGULARISATION = 1e-12
# Relative cut-off of singular values of the step's system.
STEP_RCOND = 1e-15
# Step of numeric derivatives. Parameters are scaled so that one unit moves the image by about a pixel; points are moved
# by this part of their distance.
DIFFERENCE_STEP = 1e-4


class Projection(Protocol):
    """A camera, or several combined, that projects points."""

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3), NaN for points without an image."""


CameraFactory = Callable[[Array], Projection]


@dataclass(frozen=True, slots=True)
class Observations:
    """Observed corners: pixels (K, N, 2) in K images, NaN for unknown corners, of board points (N, 3) [m]."""

    pixels: Array
    points: Array
    cameras: int = 1  # the points of a view are equal parts of so many cameras

    def select(self, chosen: Array) -> Observations:
        """Return the images of an index or mask."""
        return replace(self, pixels=self.pixels[chosen])


@dataclass(frozen=True, slots=True)
class Prior:
    """Independent normal distributions of the parameters before the adjustment; sigma infinite: none."""

    center: Array  # (P,)
    sigma: Array  # (P,)

    def weights(self, kernel_px: float) -> Array:
        """Return the weights (P,) of squared differences beside squared residuals, for a width of Huber's kernel."""
        return np.asarray((kernel_px / HUBER_WIDTH / self.sigma) ** 2)


@dataclass(frozen=True, slots=True)
class BundleResult:
    """The result of a bundle adjustment; residuals are measured minus modelled [px], NaN without a measurement."""

    parameters: Array  # (P,)
    T_cam_board: Array  # (K, 4, 4)
    residuals: Array  # (K, N, 2)
    covariance: Array  # (P, P), with the misfit of the model
    misfit_px: float = 0.0  # size of the smooth error of the model, most of which the parameters absorb

    @property
    def errors_px(self) -> Array:
        """Return the length (K, N) of every residual."""
        return np.asarray(np.linalg.norm(self.residuals, axis=2))

    @property
    def mean_px(self) -> float:
        """Return the mean length of the residuals, which is OCamCalib's reprojection error."""
        return float(np.nanmean(self.errors_px))


def residuals(camera: Projection, T_cam_board: Array, observed: Observations) -> Array:
    """Return measured minus modelled pixels (K, N, 2); NaN without a measurement, LOST_PX without a projection."""
    cast = camera.project(se3.apply(T_cam_board, observed.points).reshape(-1, 3)).reshape(observed.pixels.shape)
    lost = np.isnan(cast) & np.isfinite(observed.pixels)
    return np.where(lost, LOST_PX, observed.pixels - cast)


def adjust_bundle(camera_of: CameraFactory, parameters: Array, T_cam_board: Array, observed: Observations, *,
                  kernel_rounds: int = KERNEL_ROUNDS, prior: Prior | None = None) -> BundleResult:
    """Minimise the robust reprojection error over parameters (P,) and poses (K, 4, 4), from the given start values.

    kernel_rounds: number of optimisations; 1 is enough if the start values are nearly right.
    """
    parameters = np.asarray(parameters, float)
    none = Prior(np.zeros(len(parameters)), np.full(len(parameters), np.inf))
    state = _State(camera_of, observed, parameters, np.asarray(T_cam_board, float), prior or none)
    sigma = np.inf
    for _ in range(kernel_rounds):
        sigma = min(sigma, _robust_sigma(state.residuals))
        state = _levenberg_marquardt(state, HUBER_WIDTH * sigma)
    return _bundle_result(state, HUBER_WIDTH * sigma)


def _robust_sigma(residual: Array) -> float:
    """Return the standard deviation [px] of one coordinate, by the median of absolute residuals."""
    return max(MIN_SIGMA_PX, SIGMA_PER_MAD * float(np.nanmedian(np.abs(residual))))


class _State:
    """One iterate of the optimisation, with its residuals."""

    __slots__ = ("camera_of", "observed", "parameters", "poses", "prior", "residuals")

    def __init__(self, camera_of: CameraFactory, observed: Observations, parameters: Array, poses: Array, prior: Prior
                 ) -> None:
        self.camera_of, self.observed, self.parameters, self.poses = camera_of, observed, parameters, poses
        self.prior = prior
        self.residuals = residuals(camera_of(parameters), poses, observed)

    def moved(self, intrinsic: Array, pose: Array) -> _State | None:
        """Return the state after a step; None if the parameters are not those of a camera."""
        try:
            return _State(self.camera_of, self.observed, self.parameters + intrinsic, se3.exp(pose) @ self.poses,
                          self.prior)
        except (CalibError, np.linalg.LinAlgError):
            return None

    def cost(self, kernel_px: float) -> float:
        """Return the sum of Huber's function over the corners, and of the prior."""
        length = np.linalg.norm(self.residuals, axis=2)
        huber = np.where(length <= kernel_px, length**2, kernel_px * (2 * length - kernel_px))
        return float(np.nansum(huber) + self.prior.weights(kernel_px) @ (self.parameters - self.prior.center) ** 2)


@dataclass(frozen=True, slots=True)
class _NormalEquations:
    """Weighted normal equations [[A, B], [B^T, C]] [intrinsics; poses] = [a; c], with C block diagonal."""

    A: Array  # (P, P) intrinsics
    B: Array  # (K, P, 6) intrinsics by poses
    C: Array  # (K, 6, 6) poses
    a: Array  # (P,)
    c: Array  # (K, 6)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the damped steps of the intrinsics (P,) and of the poses (K, 6), by the Schur complement."""
        C = self.C + damping * _diagonals(self.C)
        BC = self.B @ np.linalg.inv(C)
        S = self.A + damping * np.diag(np.diag(self.A)) - (BC @ self.B.swapaxes(1, 2)).sum(axis=0)
        intrinsic = np.linalg.lstsq(S, self.a - (BC @ self.c[..., None]).sum(axis=0)[:, 0], rcond=STEP_RCOND)[0]
        pose = np.linalg.solve(C, (self.c - intrinsic @ self.B)[..., None])[..., 0]
        return intrinsic, pose

    def reduced(self) -> tuple[Array, Array]:
        """Return the system (P, P) and right side (P,) of the intrinsics, the poses eliminated."""
        BC = self.B @ np.linalg.inv(self.C)
        return self.A - (BC @ self.B.swapaxes(1, 2)).sum(axis=0), self.a - (BC @ self.c[..., None]).sum(axis=0)[:, 0]


def _diagonals(C: Array) -> Array:
    return np.asarray(C * np.eye(C.shape[-1]) + POSE_REGULARISATION * np.eye(C.shape[-1]))


def _levenberg_marquardt(state: _State, kernel_px: float) -> _State:
    """Minimise the cost for one width of the kernel."""
    damping, cost = START_DAMPING, state.cost(kernel_px)
    normal = _normal_equations(state, kernel_px)
    for _ in range(MAX_STEPS):
        trial = state.moved(*normal.step(damping))
        new_cost = trial.cost(kernel_px) if trial is not None else np.inf
        if trial is None or not new_cost < cost:
            damping *= DAMPING_UP
            if damping > MAX_DAMPING:
                break
            continue
        state, saved, cost = trial, cost - new_cost, new_cost
        if saved < CONVERGED_PART * cost and damping < CONVERGED_DAMPING:
            break
        damping = max(MIN_DAMPING, damping / DAMPING_DOWN)
        normal = _normal_equations(state, kernel_px)
    return state


def _normal_equations(state: _State, kernel_px: float, fields: Array | None = None) -> _NormalEquations:
    """Return the normal equations; fields (K, N, 2, F): further unknowns after the intrinsics, 0 now."""
    residual, weight = _huber_weights(state.residuals, kernel_px)
    J_in, J_pose = _jacobians(state)
    K = len(residual)
    root = np.sqrt(weight)[..., None, None]
    J_in, J_pose = ((root * J).reshape(K, 2 * residual.shape[1], J.shape[-1]) for J in (J_in, J_pose))
    r = (root[..., 0] * residual).reshape(K, -1)
    prior = state.prior.weights(kernel_px)
    to_prior = prior * (state.parameters - state.prior.center)
    if fields is not None:
        J_in = np.concatenate([J_in, (root * fields).reshape(K, 2 * residual.shape[1], -1)], axis=2)
        prior, to_prior = (np.pad(part, (0, fields.shape[3])) for part in (prior, to_prior))
    return _NormalEquations(
        A=np.tensordot(J_in, J_in, axes=((0, 1), (0, 1))) + np.diag(prior), B=J_in.swapaxes(1, 2) @ J_pose,
        C=J_pose.swapaxes(1, 2) @ J_pose,
        a=np.einsum("kri,kr->i", J_in, r) - to_prior,
        c=np.einsum("kri,kr->ki", J_pose, r))


def _huber_weights(residual: Array, kernel_px: float) -> tuple[Array, Array]:
    """Return residuals with 0 for missing ones, and Huber's weights (K, N)."""
    length = np.linalg.norm(residual, axis=2)
    weight = np.where(np.isfinite(length), np.minimum(1.0, kernel_px / np.maximum(length, 1e-12)), 0.0)
    return np.nan_to_num(residual), weight


def _jacobians(state: _State) -> tuple[Array, Array]:
    """Return derivatives of the modelled pixels by parameters (K, N, 2, P) and by left twists of poses (K, N, 2, 6)."""
    points = se3.apply(state.poses, state.observed.points)
    flat = points.reshape(-1, 3)
    columns = []
    for step in DIFFERENCE_STEP * np.eye(len(state.parameters)):
        ahead, behind = (state.camera_of(state.parameters + sign * step).project(flat) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * DIFFERENCE_STEP))
    by_parameter = np.nan_to_num(np.stack(columns, axis=-1)) if columns else np.zeros((len(flat), 2, 0))
    by_point = _by_point(state.camera_of(state.parameters), flat)
    by_pose = np.concatenate([by_point, -by_point @ se3.hat(flat)], axis=-1)
    shape = points.shape[:2]
    return by_parameter.reshape(*shape, 2, len(columns)), by_pose.reshape(*shape, 2, 6)


def _by_point(camera: Projection, points: Array) -> Array:
    """Return the derivative (N, 2, 3) of the pixels by the points."""
    reach = DIFFERENCE_STEP * np.linalg.norm(points, axis=1, keepdims=True)
    columns = [(camera.project(points + reach * axis) - camera.project(points - reach * axis)) / (2 * reach)
               for axis in np.eye(3)]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=-1)))


def _bundle_result(state: _State, kernel_px: float) -> BundleResult:
    residual, weight = _huber_weights(state.residuals, kernel_px)
    freedom = 2 * float(weight.sum()) - state.parameters.size - 6 * len(residual)
    variance = float((weight[..., None] * residual**2).sum()) / max(freedom, 1.0)
    if not state.parameters.size:
        return BundleResult(state.parameters, state.poses, state.residuals, np.zeros((0, 0)))
    fields = smooth_fields(state.observed.pixels, state.observed.cameras)
    system = _normal_equations(state, kernel_px, fields).reduced()
    covariance, misfit_px = covariance_with_misfit(*system, state.parameters.size, variance)
    return BundleResult(state.parameters, state.poses, state.residuals, covariance, misfit_px)
