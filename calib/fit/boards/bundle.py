"""One estimate of the cameras that saw a board, the transform between them, the shape of the print, and its poses.

The estimate is the most likely one (maximum a posteriori): it minimises robust residuals of the corners, and priors of
what a good mirror, lens or print hardly has. Terms that the images do not show are shrunk towards 0 by their prior, so
none has to be selected. Every instant has a pose of the board, a block of six unknowns of the normal equations.

The wavefront of a camera below a mirror is free, or that of a paraboloid below a telecentric lens. A camera along
parallel rays sees by the mirror z = rho^2 / (2 h) the stereographic image rho = h m of directions m
(calib/models/wavefront.py). To first order a mirror that is higher by g(rho) moves the image by -h grad g, and
lengthens the light's way by 2 q g, which is the support function of its wavefront. A camera tilted by t below the
mirror moves the image by h t m^2, and its wavefront is h t m. So, with the terms of calib/models/ocam.py,

    spherical aberration   w_s = -8 |a0|^3 a4 h          (g = rho^4)
    astigmatism            w_a = (c - 1) h / 2,   w_b = (d + e) h      (g = x^2 - y^2, x y)
    coma                   w_x = 4 |a0| p2 h,     w_y = 4 |a0| p1 h    (t)

up to lower terms, which only move the viewpoint. Boards show w_s and a4 only together: apart they are the largest
uncertainty of lengths. The radius h of the horizon on the mirror [m] is unknown too; coma and astigmatism show it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import scipy

from calib import se3
from calib.boards.board import MODE_NAMES, MODE_SIGMAS, AnyBoard, PrintShape, all_modes
from calib.errors import CalibError
from calib.fit.least_squares import (
    BEST_STEP,
    DAMPING_FACTOR,
    KERNEL_WIDTH,
    ROUNDS,
    START_DAMPING,
    ArrowSystem,
    central_differences,
    minimise,
    robust_sigma,
)
from calib.fit.parameters import WAVEFRONT_UNIT_M, stepped, units_of
from calib.models.camera import Array
from calib.models.names import values_of
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.wavefront import WAVEFRONT_NAMES, directions_to

# Prior of h: two of three mirrors are between 14 and 46 mm, because mirrors are 5 to 20 cm wide. With 15 or 50 mm as
# its median the lengths of ten rigs change by less than 0.01 %.
RADIUS_M, RADIUS_LOG_SIGMA = 0.025, 0.6
# Prior of what the wavefront differs from the mirror's, as a fraction of h, because there are pixels that are not
# square by a thousandth (w_a, w_b), a mirror whose own coma is that of a tilt by 0.06 degree (w_x, w_y), a lens that
# distorts its rim by a thousandth (w_s).
DEVIATIONS = np.array([5e-4, 5e-4, 1e-3, 1e-3, 3.5e-4])


def mirror_residuals(values: Mapping[str, float], log_radius: float, *, telecentric: bool) -> Array:
    """Return how far a wavefront is from the expected one, and the mirror's radius from the usual one, in sigmas (6,).

    values: all parameters of an ocam camera by name. log_radius: log(h / RADIUS_M) / RADIUS_LOG_SIGMA. Where the camera
    is not telecentric, the wavefront is expected to be 0 within a step, and the radius has no meaning.
    """
    wavefront = np.array([values[name] for name in WAVEFRONT_NAMES])
    if not telecentric:
        return np.array([*(wavefront / WAVEFRONT_UNIT_M), log_radius])
    radius_m = RADIUS_M * float(np.exp(RADIUS_LOG_SIGMA * log_radius))
    a0 = abs(values["a0"])
    expected = {
        "w_a": (values["c"] - 1) / 2,
        "w_b": values["d"] + values["e"],
        "w_x": 4 * a0 * values["p2"],
        "w_y": 4 * a0 * values["p1"],
        "w_s": -8 * a0**3 * values.get("a4", 0.0),
    }
    off = wavefront / radius_m - np.array([expected[name] for name in WAVEFRONT_NAMES])
    return np.array([*(off / DEVIATIONS), log_radius])


# The polynomial of a surface without a tip has even powers. Its terms above the fourth are 0 for a paraboloid and 0.2
# steps, which are pixels at half of the image, for a hyperboloid of xi = 0.9; astigmatism is about one step.
LENS_NAMES: Final = (
    *("a0", "a2", "a4", "a6", "a8", "center_row", "center_column", "c", "d"),
    *TANGENTIAL_NAMES,
    *ASTIGMATISM_NAMES,
)
SHRUNK: Final = ("a6", "a8", *ASTIGMATISM_NAMES)
SHRUNK_SIGMAS: Final = np.array([0.1, 0.1, 1.0, 1.0])
TWIST_NAMES: Final = ("t_x", "t_y", "t_z", "r_x", "r_y", "r_z")
# A damped step hardly moves along a flat direction: so the search ends only with a nearly undamped step that lowers the
# cost in its ninth digit.
GAIN, LAST_DAMPING = 1e-9, 1e-7


@dataclass(frozen=True, slots=True)
class BoardRig:
    """One camera, or the lower and the upper one of a rig, and the board in front of them at K instants."""

    cameras: tuple[OcamCamera, ...]  # C
    T_upper_lower: Array  # (4, 4); the identity of one camera
    T_lower_board: Array  # (K, 4, 4)
    shape: PrintShape
    log_radii: Array  # (C,) of the mirrors, see mirror_residuals

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the parameters of each camera. The rays of a lens meet in one point."""
        return LENS_NAMES if self.cameras[0].view == "direct" else (*LENS_NAMES, *WAVEFRONT_NAMES)

    def transforms(self) -> list[Array]:
        """Return the poses (K, 4, 4) of the board in the frame of each camera."""
        return [T @ self.T_lower_board for T in (np.eye(4), self.T_upper_lower)[: len(self.cameras)]]

    def residuals(self, pixels: Array, drawn: Array) -> Array:
        """Return measured minus modelled pixels (K, C, N, 2) of the corners drawn (N, 3) of the board.

        NaN without a measurement, the image's diagonal without a projection.
        """
        points = self.shape.points(drawn)
        cast = [
            camera.project_near(se3.apply(T, points).reshape(-1, 3)).reshape(len(T), len(points), 2)
            for camera, T in zip(self.cameras, self.transforms(), strict=True)
        ]
        off = pixels - np.stack(cast, axis=1)
        return np.where(np.isnan(off) & np.isfinite(pixels), np.hypot(*self.cameras[0].size), off)


@dataclass(frozen=True, slots=True)
class BoardFit:
    """The most likely cameras and boards, with the covariance of all common unknowns in their own units."""

    rig: BoardRig
    residuals: Array  # (K, C, N, 2) measured minus modelled [px], NaN without a measurement
    covariance: Array  # (P, P) of rig.names of each camera, TWIST_NAMES of two [m, rad], and MODE_NAMES [m, 1]
    cost: float  # of the robust residuals and the priors [px^2]
    variance: float  # of one coordinate of a residual [px^2]
    complexity: float  # twice the logarithm of the part by which the images narrow the priors, but for a constant

    def is_likelier(self, other: BoardFit) -> bool:
        """True if the images make this model of the cameras more likely than another: the larger evidence (Laplace)."""
        return (self.cost - other.cost) / other.variance + self.complexity < other.complexity

    @property
    def errors_px(self) -> Array:
        """Return the length (K, C, N) of every residual."""
        return np.asarray(np.linalg.norm(self.residuals, axis=-1))

    @property
    def mean_px(self) -> float:
        """Return the mean length of the residuals, which is OCamCalib's reprojection error."""
        return float(np.nanmean(self.errors_px))


def fit_boards(start: BoardRig, pixels: Array, board: AnyBoard, *, telecentric: bool = False) -> BoardFit:
    """Return the most likely cameras and boards near a start, by corners (K, C, N, 2) [px], NaN for unknown ones.

    telecentric: the cameras look at mirrors by parallel rays, see mirror_residuals. CalibError where no camera fits.
    """
    reach_m = float(np.median(np.linalg.norm(se3.t_of(start.T_lower_board), axis=1)))
    problem = _BoardProblem(pixels, board.points, reach_m, telecentric, np.inf)
    state = problem.state(start)
    sigma, damping = np.inf, START_DAMPING
    for _ in range(ROUNDS):
        sigma = min(sigma, robust_sigma(state.residuals))
        problem = replace(problem, kernel_px=KERNEL_WIDTH * sigma)
        state = minimise(problem, state, GAIN, damping, LAST_DAMPING)
        damping = min(START_DAMPING, LAST_DAMPING / DAMPING_FACTOR)  # the next one begins next to its minimum
    return problem.result(state)


@dataclass(frozen=True, slots=True)
class _State:
    """One iterate of the optimisation, with its residuals and those of its priors."""

    rig: BoardRig
    residuals: Array  # (K, C, N, 2)
    priors: Array  # (Q,) in standard deviations


@dataclass(frozen=True, slots=True)
class _BoardProblem:
    """The robust reprojection error of cameras that saw boards, and the priors, for one width of the kernel.

    Common unknowns: for each camera steps of its parameters and of its mirror's radius, the twist between two, and
    those of the print's modes.
    """

    pixels: Array  # (K, C, N, 2)
    drawn: Array  # (N, 3)
    reach_m: float  # the usual distance of the board
    telecentric: bool
    kernel_px: float
    modes: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "modes", all_modes(self.drawn))

    def state(self, rig: BoardRig) -> _State:
        """Return the iterate of a rig."""
        still = np.zeros(len(rig.names) + 1)
        own = [self._camera_priors(rig, side, still) for side in range(len(rig.cameras))]
        priors = np.concatenate([*own, np.array(rig.shape.values) / MODE_SIGMAS])
        return _State(rig, rig.residuals(self.pixels, self.drawn), priors)

    def scale(self, state: _State) -> float:
        """Return the width of Huber's kernel [px], which stays during a search."""
        return self.kernel_px

    def moved(self, state: _State, common: Array, blocks: Array) -> _State | None:
        """Return the state after a step; None if the parameters are not those of a camera."""
        try:
            return self.state(self._moved(state.rig, common, blocks))
        except (CalibError, np.linalg.LinAlgError):
            return None

    def cost(self, state: _State, scale: float) -> float:
        """Return the sum of Huber's function over the corners, and of the priors."""
        length = np.linalg.norm(state.residuals, axis=-1)
        huber = np.where(length <= scale, length**2, scale * (2 * length - scale))
        return float(np.nansum(huber) + (scale / KERNEL_WIDTH) ** 2 * (state.priors @ state.priors))

    def normal_equations(self, state: _State, scale: float, fields: Array | None = None) -> ArrowSystem:
        """Return the normal equations; fields (K, C, N, 2, F): further unknowns after all others, 0 now."""
        residual, weight = _huber_weights(state.residuals, scale)
        J_common, J_pose = self._jacobians(state.rig)
        K, root = len(residual), np.sqrt(weight)[..., None, None]
        if fields is not None:
            J_common = np.concatenate([J_common, fields], axis=-1)
        J_common, J_pose = ((root * J).reshape(K, -1, J.shape[-1]) for J in (J_common, J_pose))
        r = (root[..., 0] * residual).reshape(K, -1)
        # The priors count in residuals of one standard deviation of a coordinate.
        own = self._prior_jacobian(state.rig) * (scale / KERNEL_WIDTH)
        own = np.pad(own, ((0, 0), (0, J_common.shape[-1] - own.shape[1])))
        flat = J_common.reshape(-1, J_common.shape[-1])
        return ArrowSystem(
            A=flat.T @ flat + own.T @ own,
            B=(J_common.swapaxes(1, 2) @ J_pose).swapaxes(0, 1).reshape(flat.shape[1], 6 * K),
            C=J_pose.swapaxes(1, 2) @ J_pose,
            a=flat.T @ r.ravel() - own.T @ state.priors * (scale / KERNEL_WIDTH),
            c=np.einsum("kri,kr->ki", J_pose, r).ravel(),
        )

    def result(self, state: _State) -> BoardFit:
        """Return the result, in whose covariance the misfit of the model is counted."""
        # 1. The variance of a coordinate.
        residual, weight = _huber_weights(state.residuals, self.kernel_px)
        units = self._units(state.rig)
        freedom = 2 * float(weight.sum()) - len(units) - 6 * len(residual)
        variance = float((weight[..., None] * residual**2).sum()) / max(freedom, 1.0)
        # 2. The covariance. The radii of the mirrors are no parameters of a rig.
        C = len(state.rig.cameras)
        system = self.normal_equations(state, self.kernel_px, smooth_fields(self.pixels)).reduced()
        covariance = covariance_with_misfit(*system, len(units), variance) * np.outer(units, units)
        own = [(*state.rig.names, "radius")] * C
        names = [name for side in own for name in side] + [""] * (len(units) - C * len(own[0]))
        kept = [k for k, name in enumerate(names) if name != "radius"]
        # 3. How much the images narrow the priors of wavefronts and radii, which differ between the models of mirrors.
        mirror = [k for k, name in enumerate(names) if name in (*WAVEFRONT_NAMES, "radius")]
        prior = self._prior_jacobian(state.rig)[:, mirror]
        complexity = np.linalg.slogdet(system[0][: len(units), : len(units)])[1] - np.linalg.slogdet(prior.T @ prior)[1]
        return BoardFit(
            state.rig,
            state.residuals,
            covariance[np.ix_(kept, kept)],
            self.cost(state, self.kernel_px),
            variance,
            float(complexity),
        )

    def _units(self, rig: BoardRig) -> Array:
        """Return one step (P,) of each common unknown in its own unit; a step moves the image by about a pixel."""
        cameras = [[*units_of(camera, rig.names), 1.0] for camera in rig.cameras]
        # The focal length is about a quarter of the image.
        twist = np.repeat([self.reach_m, 1.0], 3) / (min(rig.cameras[0].size) / 4)
        return np.concatenate([*cameras, *([twist] if len(cameras) > 1 else []), MODE_SIGMAS])

    def _moved(self, rig: BoardRig, common: Array, blocks: Array) -> BoardRig:
        """Return the rig after steps of the common unknowns (P,) and of the poses (K, 6)."""
        n, C = len(rig.names) + 1, len(rig.cameras)
        own, twist, modes = common[: C * n].reshape(C, n), common[C * n : -len(MODE_NAMES)], common[-len(MODE_NAMES) :]
        cameras = [stepped(camera, rig.names, steps[:-1]) for camera, steps in zip(rig.cameras, own, strict=True)]
        T_upper_lower = rig.T_upper_lower
        if len(twist):
            T_upper_lower = se3.exp(twist * self._units(rig)[C * n : C * n + 6]) @ T_upper_lower
        return BoardRig(
            tuple(camera for camera in cameras if isinstance(camera, OcamCamera)),
            T_upper_lower,
            se3.exp(blocks) @ rig.T_lower_board,
            rig.shape.moved(modes),
            rig.log_radii + own[:, -1],
        )

    def _jacobians(self, rig: BoardRig) -> tuple[Array, Array]:
        """Return derivatives of the pixels by common unknowns (K, C, N, 2, P) and by left twists (K, C, N, 2, 6)."""
        K, C, N, _ = self.pixels.shape
        n, units, drawn = len(rig.names) + 1, self._units(rig), rig.shape.points(self.drawn)
        J_common, J_pose = np.zeros((K, C, N, 2, len(units))), np.zeros((K, C, N, 2, 6))
        for side, (camera, T) in enumerate(zip(rig.cameras, rig.transforms(), strict=True)):
            points = se3.apply(T, drawn).reshape(-1, 3)
            by_point, by_own = pixel_derivatives(camera, points, rig.names)
            own = slice(side * n, side * n + n - 1)
            J_common[:, side, ..., own] = by_own.reshape(K, N, 2, -1) * units[own]
            by_mode = np.einsum("kij,njs->knis", se3.R_of(T), self.modes)
            J_common[:, side, ..., -len(MODE_NAMES) :] = by_point.reshape(K, N, 2, 3) @ by_mode
            if side:
                twist = np.concatenate([by_point, -by_point @ se3.hat(points)], axis=-1).reshape(K, N, 2, 6)
                J_common[:, side, ..., C * n : C * n + 6] = twist * units[C * n : C * n + 6]
                points = (points - se3.t_of(rig.T_upper_lower)) @ se3.R_of(rig.T_upper_lower)
                by_point = by_point @ se3.R_of(rig.T_upper_lower)
            pose = np.concatenate([by_point, -by_point @ se3.hat(points)], axis=-1)
            J_pose[:, side] = pose.reshape(K, N, 2, 6)
        return J_common, J_pose

    def _prior_jacobian(self, rig: BoardRig) -> Array:
        """Return the derivatives (Q, P) of the priors by the common unknowns."""
        step = BEST_STEP * np.ones(len(rig.names) + 1)
        blocks = [
            central_differences(lambda steps, side=side: self._camera_priors(rig, side, steps), step)  # type: ignore[misc]
            for side in range(len(rig.cameras))
        ]
        twist = np.zeros((0, 6 * (len(blocks) - 1)))
        return np.asarray(scipy.linalg.block_diag(*blocks, twist, np.eye(len(MODE_SIGMAS))))

    def _camera_priors(self, rig: BoardRig, side: int, steps: Array) -> Array:
        """Return the differences of a camera after steps of its parameters and radius from what is expected of it."""
        camera = rig.cameras[side]
        values = values_of(camera)
        for name, change in zip(rig.names, (steps[:-1] * units_of(camera, rig.names)).tolist(), strict=True):
            values[name] = values.get(name, 0.0) + change
        values["e"] += values["d"] - camera.affine[1]
        shrunk = np.array([values[name] for name in SHRUNK]) / units_of(camera, SHRUNK) / SHRUNK_SIGMAS
        log_radius = float(rig.log_radii[side] + steps[-1])
        return np.concatenate([shrunk, mirror_residuals(values, log_radius, telecentric=self.telecentric)])


def _huber_weights(residual: Array, kernel_px: float) -> tuple[Array, Array]:
    """Return residuals with 0 for missing ones, and Huber's weights (K, C, N)."""
    length = np.linalg.norm(residual, axis=-1)
    weight = np.where(np.isfinite(length), np.minimum(1.0, kernel_px / np.maximum(length, 1e-12)), 0.0)
    return np.nan_to_num(residual), weight


@np.errstate(all="ignore")
def pixel_derivatives(camera: OcamCamera, points: Array, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the derivatives (N, 2, 3) by points (N, 3) [m], near ones as they are, and (N, 2, P) by the parameters.

    They are 0 where the camera does not see a point. Scaramuzza et al. 2006, with the implicit function f(rho) r - z
    rho = 0 for the radius; by differences for wavefronts. d moves e along, as in models/names.py.
    """
    waves = [name for name in names if name in WAVEFRONT_NAMES]
    # 1. The direction of the ray through the point, of a mirror whose rays do not meet in one point.
    ray_by_point, rays = None, points
    ray_by_wave = dict[str, Array]()
    if waves or any(camera.wavefront):
        axis, wavefront = -camera.sign, np.array(camera.wavefront)
        rays = directions_to(points, camera.wavefront, axis)
        step = BEST_STEP * np.ones(len(wavefront))
        ray_by_point = central_differences(lambda by: directions_to(points + by, camera.wavefront, axis), step[:3])
        by_term = central_differences(lambda by: directions_to(points, tuple((wavefront + by).tolist()), axis), step)
        ray_by_wave = {name: by_term[..., WAVEFRONT_NAMES.index(name)] for name in waves}
    # 2. The radius of that direction.
    X, Y, z = rays[:, 0], rays[:, 1], camera.sign * rays[:, 2]
    r = np.hypot(X, Y)
    rho = camera.radius(r, z)
    f, slope = camera.height_and_slope(rho)
    by_rho = slope * r - z
    is_off_axis = r > 1e-12 * np.abs(z)
    safe = np.where(is_off_axis, r, 1.0)
    ux, uy = np.where(is_off_axis, X / safe, 0.0), np.where(is_off_axis, Y / safe, 0.0)
    ratio = np.where(is_off_axis, rho / safe, f / z)
    rho_by_r, rho_by_z = -f / by_rho, rho / by_rho
    # 3. The ideal point rho (X, Y) / r.
    x, y = X * ratio, Y * ratio
    cross = (rho_by_r - ratio) * ux * uy
    ideal_by_ray = np.stack(
        [
            _pairs(ratio + (rho_by_r - ratio) * ux * ux, cross),
            _pairs(cross, ratio + (rho_by_r - ratio) * uy * uy),
            _pairs(ux, uy) * (camera.sign * rho_by_z)[:, None],
        ],
        axis=2,
    )
    # 4. Tangential and astigmatic terms, and the affine.
    bent_x, bent_y = camera.distort(x, y)
    xx, xy, yy = camera.distortion_jacobian(x, y)
    c, d, e = camera.affine
    affine = np.array([[e, 1.0], [c, d]])
    A = affine @ np.stack([_pairs(xx, xy), _pairs(xy, yy)], axis=1)
    by_ray = A @ ideal_by_ray
    x2, y2, rho2, zero, one = x * x, y * y, x * x + y * y, np.zeros(len(x)), np.ones(len(x))
    columns = {
        "center_row": _pairs(zero, one),
        "center_column": _pairs(one, zero),
        "c": _pairs(zero, bent_x),
        "d": _pairs(bent_x, bent_y),
        TANGENTIAL_NAMES[0]: _pairs(2 * x * y, rho2 + 2 * y2) @ affine.T,
        TANGENTIAL_NAMES[1]: _pairs(rho2 + 2 * x2, 2 * x * y) @ affine.T,
        ASTIGMATISM_NAMES[0]: _pairs(4 * x2 * x, -4 * y2 * y) @ affine.T,
        ASTIGMATISM_NAMES[1]: _pairs(6 * x2 * y + 2 * y2 * y, 2 * x2 * x + 6 * x * y2) @ affine.T,
    }
    for name in names:
        if name[0] == "a":
            columns[name] = np.einsum("nij,nj->ni", A, _pairs(ux, uy) * (-r * rho ** int(name[1:]) / by_rho)[:, None])
    columns |= {name: np.einsum("nij,nj->ni", by_ray, change) for name, change in ray_by_wave.items()}
    by_point = by_ray if ray_by_point is None else by_ray @ ray_by_point
    by_name = np.stack([columns[name] for name in names], axis=2)
    return np.nan_to_num(by_point, posinf=0.0, neginf=0.0), np.nan_to_num(by_name, posinf=0.0, neginf=0.0)


def _pairs(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=1)


# The error of a camera model is a smooth function of the image position, the same in all views. Most of it is absorbed
# by the parameters, which it shifts; what remains correlates the residuals, and this correlation shows its size. So
# residuals have the covariance sigma^2 I + tau^2 F F^T, where the columns of F are smooth fields: gradients of
# Gaussian functions on a grid. A mirror or lens whose surface is not the model's deflects rays by the gradient of the
# difference of the surfaces, so such fields have no swirl: they move elevations, and hardly turn a camera about its
# axis.
#
# tau^2 is the mean of its posterior distribution by the restricted likelihood (Patterson and Thompson 1971) with a
# flat prior of tau / sigma (Gelman 2006): the most likely value of few data is often 0.
#
# Nodes of the fields along the diameter of the seen part of an image: five follow three waves over the azimuth and a
# turning point over the radius. Each field is as wide as the distance of two nodes.
NODES = 5
# Values of tau / sigma over which the posterior is summed: steps of 4 % are fine enough for any ratio.
RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 240)])
# Smaller eigenvalues of what the fields explain beyond the parameters, as a fraction of the largest, are rounding.
MIN_EIGENVALUE_RATIO = 1e-3


def smooth_fields(pixels: Array) -> Array:
    """Return the fields (K, C, N, 2, F) at the pixels (K, C, N, 2) of C cameras, of which each has its own.

    Rows of unknown pixels (NaN) are 0. The sum of all fields has about unit size.
    """
    K, C, N, _ = pixels.shape
    line, width = np.linspace(-1, 1, NODES), 2 / (NODES - 1)
    nodes = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    fields = np.zeros((K, C, N, 2, C, len(nodes)))
    for camera, part in enumerate(np.moveaxis(pixels, 1, 0)):
        known = part[np.isfinite(part).all(axis=2)]
        center = known.mean(axis=0)
        radius = float(np.linalg.norm(known - center, axis=1).max())
        away = ((part[:, :, None] - center) / radius - nodes) / width
        gaussian = np.exp(-0.5 * (away**2).sum(axis=3, keepdims=True))
        fields[:, camera, :, :, camera] = np.nan_to_num(-away * gaussian).swapaxes(2, 3)
    return fields.reshape(K, C, N, 2, -1)


def covariance_with_misfit(normal: Array, gradient: Array, parameters: int, variance: float) -> Array:
    """Return the covariance (P, P) of the parameters.

    normal (P + F, P + F), gradient (P + F,): of the weighted residuals by parameters and fields, poses eliminated, at
    the fit's minimum; variance: sigma^2 of a coordinate [px^2].
    """
    P = parameters
    inverse = np.linalg.pinv(normal[:P, :P], rcond=1e-14, hermitian=True)
    # What the fields explain beyond the parameters: y ~ N(0, sigma^2 d + tau^2 d^2) along each eigenvector.
    by_field = normal[P:, :P] @ inverse
    unexplained = normal[P:, P:] - by_field @ normal[:P, P:]
    d, axes = np.linalg.eigh((unexplained + unexplained.T) / 2)
    known = d > MIN_EIGENVALUE_RATIO * max(float(d[-1]), 1.0)
    d, y = d[known], (axes.T @ (gradient[P:] - by_field @ gradient[:P]))[known]
    # The posterior mean of (tau / sigma)^2.
    spread = variance * (d + RATIOS[:, None] ** 2 * d**2)
    cost = (np.log(spread) + y**2 / spread).sum(axis=1)
    weight = np.exp(-0.5 * (cost - cost.min())) * np.gradient(RATIOS)
    ratio2 = float(weight @ RATIOS**2 / weight.sum()) if len(d) else 0.0
    # The fit does not know the fields: each shifts the parameters by its row of by_field, which has the prior tau.
    return np.asarray(variance * (inverse + ratio2 * by_field.T @ by_field))
