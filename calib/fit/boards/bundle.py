"""Bundle adjustment of one camera and the poses of a board, with a Huber kernel.

Every image has its own pose, which is a block of six unknowns of the normal equations (`least_squares.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.fit.boards.smooth_misfit import covariance_with_misfit, smooth_fields
from calib.fit.least_squares import DAMPING_FACTOR, START_DAMPING, ArrowSystem, Ending, minimise
from calib.fit.robust_scale import robust_sigma
from calib.models.camera import Array

# A damped step hardly moves along a flat direction, such as xi against the focal length: so the search ends only with a
# nearly undamped step that lowers the cost in its ninth digit. The number of steps is a bound that is never reached by
# good data.
ENDING = Ending(steps=60, gain=1e-9, damping=1e-7)
# Number of optimisations, each with the kernel's width estimated again, because the width depends on the residuals and
# these on the width.
KERNEL_ROUNDS = 3
# Width of Huber's kernel in standard deviations of one coordinate, because 1 of 23 normal residuals (2-D) is longer.
HUBER_WIDTH = 2.5
# Least standard deviation assumed for a coordinate: exact corners would make the kernel's width 0.
MIN_SIGMA_PX = 0.02
# Residual of a corner that the model cannot project: larger than any residual of a corner in the image.
LOST_PX = 300.0


class Projection(Protocol):
    """A camera, or several combined, that projects points."""

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3), NaN for points without an image."""


class Parameters(Protocol):
    """A camera that depends on steps (P,), which are 0 at the start of a fit."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names (P,) of the steps."""

    def camera_at(self, steps: Array) -> Projection:
        """Return the camera at the steps; CalibError if there is none."""

    def derivatives(self, steps: Array, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of the pixels by points (N, 3), (N, 2, 3), and by the steps, (N, 2, P)."""


@dataclass(frozen=True, slots=True)
class Observations:
    """Observed corners: pixels (K, N, 2) in K images, NaN for unknown corners, of board points (N, 3) [m].

    modes (N, 3, S) [m]: the board's points are points + modes @ steps, with unknown steps (S,) common to all views.
    """

    pixels: Array
    points: Array
    cameras: int = 1  # number of cameras that share the points of a view in equal parts
    modes: Array | None = None

    @property
    def mode_count(self) -> int:
        """Return the number S of unknown modes of the board's shape."""
        return 0 if self.modes is None else self.modes.shape[2]

    def points_at(self, steps: Array) -> Array:
        """Return the board's points (N, 3) [m] after steps (S,) of its modes."""
        return self.points if self.modes is None else self.points + self.modes @ steps

    def select(self, chosen: Array) -> Observations:
        """Return the images of an index or mask."""
        return replace(self, pixels=self.pixels[chosen])


@dataclass(frozen=True, slots=True)
class Prior:
    """Independent normal distributions of the parameters before the adjustment; sigma infinite: none."""

    center: Array  # (P,)
    sigma: Array  # (P,)

    def weights(self, kernel_px: float) -> Array:
        """Return the weights (P,) of squared differences by those of residuals, for a width of Huber's kernel."""
        return np.asarray((kernel_px / HUBER_WIDTH / self.sigma) ** 2)


@dataclass(frozen=True, slots=True)
class BundleResult:
    """The result of a bundle adjustment; residuals are measured minus modelled [px], NaN without a measurement."""

    parameters: Array  # (P,)
    T_cam_board: Array  # (K, 4, 4)
    residuals: Array  # (K, N, 2)
    covariance: Array  # (P, P), with the misfit of the model
    cost: float = 0.0  # of the robust residuals and the prior [px^2]
    board_steps: Array = field(default_factory=lambda: np.zeros(0))  # (S,) of the modes of the board's shape
    board_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (S, S), with the misfit of the model

    @property
    def errors_px(self) -> Array:
        """Return the length (K, N) of every residual."""
        return np.asarray(np.linalg.norm(self.residuals, axis=2))

    @property
    def mean_px(self) -> float:
        """Return the mean length of the residuals, which is OCamCalib's reprojection error."""
        return float(np.nanmean(self.errors_px))


def residuals(camera: Projection, T_cam_board: Array, observed: Observations, points: Array) -> Array:
    """Return measured minus modelled pixels (K, N, 2) of board points (N, 3).

    NaN without a measurement, LOST_PX without a projection.
    """
    cast = camera.project(se3.apply(T_cam_board, points).reshape(-1, 3)).reshape(observed.pixels.shape)
    lost = np.isnan(cast) & np.isfinite(observed.pixels)
    return np.where(lost, LOST_PX, observed.pixels - cast)


def adjust_bundle(
    parameters: Parameters,
    T_cam_board: Array,
    observed: Observations,
    *,
    kernel_rounds: int = KERNEL_ROUNDS,
    prior: Prior | None = None,
    ending: Ending = ENDING,
    has_covariance: bool = True,
) -> BundleResult:
    """Minimise the robust reprojection error over parameters (P,) and poses (K, 4, 4), from the given start values.

    The steps (S,) of the board's modes, if it has any, are unknowns too, and start at 0.
    kernel_rounds: number of optimisations; 1 is enough if the start values are nearly right. has_covariance: without,
    the result's is empty.
    """
    count = len(parameters.names)
    none = Prior(np.zeros(count), np.full(count, np.inf))
    problem = _BoardProblem(parameters, observed, prior or none, np.inf)
    state = problem.state(np.zeros(count), np.zeros(observed.mode_count), np.asarray(T_cam_board, float))
    sigma, damping = np.inf, START_DAMPING
    for _ in range(kernel_rounds):
        sigma = min(sigma, robust_sigma(state.residuals, MIN_SIGMA_PX))
        problem = replace(problem, kernel_px=HUBER_WIDTH * sigma)
        state = minimise(problem, state, ending, damping)
        damping = min(START_DAMPING, ending.damping / DAMPING_FACTOR)  # the next one begins next to its minimum
    return _bundle_result(problem, state, has_covariance=has_covariance)


@dataclass(frozen=True, slots=True)
class _State:
    """One iterate of the optimisation, with its residuals."""

    parameters: Array  # (P,)
    board_steps: Array  # (S,)
    poses: Array  # (K, 4, 4)
    residuals: Array  # (K, N, 2)


@dataclass(frozen=True, slots=True)
class _BoardProblem:
    """The robust reprojection error of a camera that saw boards, for one width of the kernel.

    Its common unknowns are the camera's parameters (P,), then the steps (S,) of the board's modes.
    """

    unknowns: Parameters
    observed: Observations
    prior: Prior
    kernel_px: float

    def state(self, parameters: Array, board_steps: Array, poses: Array) -> _State:
        """Return the iterate with these parameters and poses; CalibError if there is no such camera."""
        points = self.observed.points_at(board_steps)
        return _State(
            parameters, board_steps, poses, residuals(self.unknowns.camera_at(parameters), poses, self.observed, points)
        )

    def scale(self, state: _State) -> float:
        """Return the width of Huber's kernel [px], which stays during a search."""
        return self.kernel_px

    def moved(self, state: _State, common: Array, blocks: Array) -> _State | None:
        """Return the state after a step; None if the parameters are not those of a camera."""
        try:
            P = state.parameters.size
            return self.state(
                state.parameters + common[:P], state.board_steps + common[P:], se3.exp(blocks) @ state.poses
            )
        except (CalibError, np.linalg.LinAlgError):
            return None

    def cost(self, state: _State, scale: float) -> float:
        """Return the sum of Huber's function over the corners, and of the prior."""
        length = np.linalg.norm(state.residuals, axis=2)
        huber = np.where(length <= scale, length**2, scale * (2 * length - scale))
        return float(np.nansum(huber) + self.prior.weights(scale) @ (state.parameters - self.prior.center) ** 2)

    def normal_equations(self, state: _State, scale: float, fields: Array | None = None) -> ArrowSystem:
        """Return the normal equations; fields (K, N, 2, F): further unknowns after all others, 0 now."""
        residual, weight = _huber_weights(state.residuals, scale)
        J_in, J_pose = self._jacobians(state)
        K, rows = len(residual), 2 * residual.shape[1]
        root = np.sqrt(weight)[..., None, None]
        J_in, J_pose = ((root * J).reshape(K, rows, J.shape[-1]) for J in (J_in, J_pose))
        r = (root[..., 0] * residual).reshape(K, -1)
        prior = self.prior.weights(scale)
        to_prior = prior * (state.parameters - self.prior.center)
        if fields is not None:
            J_in = np.concatenate([J_in, (root * fields).reshape(K, rows, -1)], axis=2)
        # Neither the board's shape nor the fields have a prior.
        prior, to_prior = (np.pad(part, (0, J_in.shape[2] - len(part))) for part in (prior, to_prior))
        flat = J_in.reshape(K * rows, J_in.shape[2])
        between = (J_in.swapaxes(1, 2) @ J_pose).swapaxes(0, 1).reshape(J_in.shape[2], 6 * K)
        return ArrowSystem(
            A=flat.T @ flat + np.diag(prior),
            B=between,
            C=J_pose.swapaxes(1, 2) @ J_pose,
            a=flat.T @ r.ravel() - to_prior,
            c=np.einsum("kri,kr->ki", J_pose, r).ravel(),
        )

    def _jacobians(self, state: _State) -> tuple[Array, Array]:
        """Return derivatives of modelled pixels by common unknowns (K, N, 2, P + S) and left twists (K, N, 2, 6)."""
        points = se3.apply(state.poses, self.observed.points_at(state.board_steps))
        flat, shape = points.reshape(-1, 3), points.shape[:2]
        by_point, by_parameter = map(_finite, self.unknowns.derivatives(state.parameters, flat))
        by_pose = np.concatenate([by_point, -by_point @ se3.hat(flat)], axis=-1)
        by_common = by_parameter.reshape(*shape, 2, by_parameter.shape[2])
        if self.observed.modes is not None:
            turned = np.einsum("kij,njs->knis", state.poses[:, :3, :3], self.observed.modes)
            by_common = np.concatenate([by_common, by_point.reshape(*shape, 2, 3) @ turned], axis=3)
        return by_common, by_pose.reshape(*shape, 2, 6)


def _huber_weights(residual: Array, kernel_px: float) -> tuple[Array, Array]:
    """Return residuals with 0 for missing ones, and Huber's weights (K, N)."""
    length = np.linalg.norm(residual, axis=2)
    weight = np.where(np.isfinite(length), np.minimum(1.0, kernel_px / np.maximum(length, 1e-12)), 0.0)
    return np.nan_to_num(residual), weight


def _finite(values: Array) -> Array:
    """Return values with 0 for those that are not finite: a point without an image has no derivative."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _bundle_result(problem: _BoardProblem, state: _State, *, has_covariance: bool) -> BundleResult:
    """Return the result with the covariance of the common unknowns, in which the model's misfit is counted."""
    residual, weight = _huber_weights(state.residuals, problem.kernel_px)
    P, count = state.parameters.size, state.parameters.size + state.board_steps.size
    freedom = 2 * float(weight.sum()) - count - 6 * len(residual)
    variance = float((weight[..., None] * residual**2).sum()) / max(freedom, 1.0)
    if not (count and has_covariance):
        return BundleResult(state.parameters, state.poses, state.residuals, np.zeros((0, 0)))
    fields = smooth_fields(problem.observed.pixels, problem.observed.cameras)
    system = problem.normal_equations(state, problem.kernel_px, fields).reduced()
    covariance = covariance_with_misfit(*system, count, variance)
    return BundleResult(
        state.parameters,
        state.poses,
        state.residuals,
        covariance[:P, :P],
        problem.cost(state, problem.kernel_px),
        state.board_steps,
        covariance[P:, P:],
    )
