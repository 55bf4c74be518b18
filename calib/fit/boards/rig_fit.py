"""Joint bundle adjustment of two cameras, the transform between them, and the boards that they saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView, CalibrationBoard
from calib.boards.corner_refinement import refine_with_camera
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.errors import CalibError
from calib.fit.boards.bundle import BundleResult, adjust_bundle
from calib.fit.boards.camera_fit import RejectedView, outlier_views, rejected_view
from calib.fit.boards.cross_validation import cross_validated_px
from calib.fit.boards.print_shape_fit import find_print_shape
from calib.fit.boards.relative_pose import RelativePoseInitialisation, initialise_relative_pose
from calib.fit.boards.rig_problem import (
    PairView,
    Printed,
    RigParameterisation,
    Sides,
    rig_observations,
    rig_unknowns,
)
from calib.fit.boards.telecentric_mirror import TelecentricMirror
from calib.fit.residual_structure import ResidualStructure, residual_structure
from calib.models.camera import Array, OmniCamera

# One pair determines the transform, but four are expected, because with them the consensus of most shows which pair is
# wrong.
MIN_PAIRS = 4
# A bound for the loop. Each round rejects at most a third of the views, so it ends earlier for lack of pairs.
MAX_REJECTIONS = 10
# Larger mean errors mean that the images do not show one board at one time, or that the cameras are wrong, because
# corners of right ones err by 0.05 to 0.15 px.
MAX_MEAN_PX = 3.0
MOTION_NAMES = ("t_x", "t_y", "t_z", "r_x", "r_y", "r_z")
Images = Mapping[str, NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """A calibrated pair of cameras; fit has residuals (K, 2N, 2), the lower camera's first, and T_lower_board."""

    lower: OmniCamera
    upper: OmniCamera
    T_upper_lower: Array  # (4, 4)
    board: CalibrationBoard
    views: tuple[PairView, ...]
    fit: BundleResult
    parameters: tuple[tuple[tuple[str, float, float], ...], ...]  # of lower and upper: name, value, sigma
    motion_sigma: Array  # (6,) sigmas of T_upper_lower, translation [m] and rotation [rad], in the upper frame
    baseline_sigma_m: float
    covariance: Array  # (P, P) of the cameras' parameters and of T_upper_lower (as motion_sigma)
    rejected: tuple[RejectedView, ...] = ()
    shape: PrintShape = AS_DRAWN
    telecentric: bool = False  # True if the cameras were fitted as mirrors below telecentric lenses

    @property
    def baseline_m(self) -> float:
        """Return the distance of the viewpoints [m]."""
        return float(np.linalg.norm(self.T_upper_lower[:3, 3]))

    @property
    def pairs(self) -> int:
        """Return the number of instants at which both cameras saw the board."""
        return sum(map(_is_pair, self.views))

    def side_errors_px(self, side: int) -> Array:
        """Return the mean error (K,) of every view in the lower (0) or upper (1) camera; NaN without a view."""
        errors = np.split(self.fit.errors_px, 2, axis=1)[side]
        known = np.isfinite(errors)
        return np.where(known.any(axis=1), np.nansum(errors, axis=1) / np.maximum(known.sum(axis=1), 1), np.nan)

    def structure(self, side: int) -> ResidualStructure:
        """Return the structure of the lower (0) or upper (1) camera's residuals."""
        views = [view.seen[side] for view in self.views]
        seen = [k for k, view in enumerate(views) if view is not None]
        pixels = np.array([view.pixels for view in views if view is not None])
        camera = (self.lower, self.upper)[side]
        residuals = np.split(self.fit.residuals, 2, axis=1)[side][seen]
        return residual_structure(pixels, residuals, self.board.points, camera.center)


def fit_rig(
    views: Sequence[PairView],
    board: CalibrationBoard,
    cameras: Sides,
    shape: PrintShape = AS_DRAWN,
    telecentric: bool = False,
) -> RigCalibration:
    """Fit two cameras and the transform between them to all views; outlier views are rejected.

    cameras: start values. shape: start value of the print's shape, whose free
    modes are fitted. The terms of real mirrors (MIRROR_NAMES) are fitted if a start value has a wavefront, each for
    itself or, if telecentric, as those of mirrors below telecentric lenses. Raises CalibError if fewer than MIN_PAIRS
    pairs are consistent, or if the order of the board's corners is ambiguous.
    """
    # 1. Relative pose initialisation; inconsistent views are rejected.
    _require(sum(_is_pair(view) for view in views), "instants at which both cameras saw the board")
    initial = initialise_relative_pose([view.seen for view in views], board, cameras)
    rejected = [RejectedView(views[k].name, reason) for k, reason in initial.rejected]
    good, T_lower_board = _reordered_views(views, initial)
    # 2. Bundle adjustment, repeated without the views that fit much worse than the others.
    printed = (board, shape)
    fit, unknowns = _solve(good, printed, cameras, initial.T_upper_lower, T_lower_board, telecentric)
    for _ in range(MAX_REJECTIONS):
        bad = outlier_views(fit)
        if not bad.any():
            break
        rejected += [rejected_view(good[k].name, fit, k) for k in np.flatnonzero(bad).tolist()]
        good = [view for view, is_bad in zip(good, bad, strict=True) if not is_bad]
        _require(sum(map(_is_pair, good)), "consistent pairs of views", rejected)
        found = unknowns.camera_at(fit.parameters)
        start = (found.lower, found.upper)
        fit, unknowns = _solve(good, printed, start, found.T_upper_lower, fit.T_cam_board[~bad], telecentric)
    if fit.mean_px > MAX_MEAN_PX:
        raise CalibError(
            f"calibrate rig: the corners are {fit.mean_px:.1f} px off any rig, expected {MAX_MEAN_PX:.0f} "
            "at most; did the cameras see the board at the same time?"
        )
    return _rig_calibration(good, printed, fit, unknowns, rejected)


def refine_rig_calibration(found: RigCalibration, images: tuple[Images, Images]) -> RigCalibration:
    """Refine the corners with the calibrated cameras, and calibrate the rig again; images by the views' names.

    An instant that only one camera saw needs no image of the other.
    """
    cameras = (found.lower, found.upper)
    poses = (found.fit.T_cam_board, found.T_upper_lower @ found.fit.T_cam_board)
    views = []
    for k, view in enumerate(found.views):
        lower, upper = (
            seen and _refined_view(seen, images[side][view.name], found.board, cameras[side], poses[side][k])
            for side, seen in enumerate(view.seen)
        )
        views.append(PairView(view.name, (lower, upper)))
    again = fit_rig(views, found.board, cameras, found.shape, found.telecentric)
    return replace(again, rejected=found.rejected + again.rejected)


def _refined_view(
    seen: BoardView, image: NDArray[np.uint8], board: CalibrationBoard, camera: OmniCamera, T_cam_board: Array
) -> BoardView:
    return replace(seen, pixels=refine_with_camera(image, seen.pixels, board, camera, T_cam_board))


def _is_pair(view: PairView) -> bool:
    return None not in view.seen


def _require(count: int, what: str, rejected: Sequence[RejectedView] = ()) -> None:
    if count < MIN_PAIRS:
        left_out = "".join(f"; left out {bad.name}: {bad.reason}" for bad in rejected[:3])
        raise CalibError(
            f"calibrate rig: expected at least {MIN_PAIRS} {what}, found {count}{left_out}; hold the "
            "board where both cameras see it whole, on all sides and tilted"
        )


def _reordered_views(views: Sequence[PairView], initial: RelativePoseInitialisation) -> tuple[list[PairView], Array]:
    """Return the consistent views, upper corners in the order of the lower ones, and the board poses (K, 4, 4)."""
    kept = list(initial.T_lower_board)
    good = [_with_reordered_upper(views[k], initial.orders.get(k)) for k in kept]
    _require(
        sum(map(_is_pair, good)),
        "consistent pairs of views",
        [RejectedView(views[k].name, reason) for k, reason in initial.rejected],
    )
    return good, np.array([initial.T_lower_board[k] for k in kept])


def _with_reordered_upper(view: PairView, order: NDArray[np.intp] | None) -> PairView:
    lower, upper = view.seen
    if upper is None or order is None:
        return view
    return replace(view, seen=(lower, replace(upper, pixels=upper.pixels[order])))


def _solve(
    good: Sequence[PairView],
    printed: Printed,
    cameras: Sides,
    T_upper_lower: Array,
    T_lower_board: Array,
    telecentric: bool,
) -> tuple[BundleResult, RigParameterisation]:
    """Adjust the cameras, the transform between them, and a pose T_lower_board (K, 4, 4) for every view."""
    unknowns = rig_unknowns(printed[0], cameras, T_upper_lower, T_lower_board, telecentric=telecentric)
    observed = rig_observations(good, printed)
    fit = adjust_bundle(unknowns, T_lower_board, observed, prior=unknowns.prior)
    return fit, unknowns


def rig_print_shape(found: RigCalibration) -> PrintShape:
    """Return the significant part of the print's shape, of a rig that was fitted to a board as drawn."""
    unknowns = _unknowns_about(found)
    observed = rig_observations(found.views, (found.board, AS_DRAWN))
    return find_print_shape(unknowns, observed, found.fit.T_cam_board, unknowns.prior)


def rig_held_out_px(found: RigCalibration) -> float:
    """Return the mean error [px] of views that were left out of the fit of both cameras and the transform."""
    unknowns = _unknowns_about(found)
    return cross_validated_px(
        unknowns,
        found.fit.T_cam_board,
        rig_observations(found.views, (found.board, found.shape), fixed=True),
        unknowns.prior,
    )


def _unknowns_about(found: RigCalibration) -> RigParameterisation:
    return rig_unknowns(
        found.board,
        (found.lower, found.upper),
        found.T_upper_lower,
        found.fit.T_cam_board,
        telecentric=found.telecentric,
    )


def _rig_calibration(
    good: Sequence[PairView],
    printed: Printed,
    fit: BundleResult,
    unknowns: RigParameterisation,
    rejected: Sequence[RejectedView],
) -> RigCalibration:
    found = unknowns.camera_at(fit.parameters)
    J = unknowns.plain_by_steps(fit.parameters)
    covariance = J @ fit.covariance @ J.T
    sigmas = iter(np.sqrt(np.maximum(0, np.diag(covariance))).tolist())
    parameters = tuple(
        tuple((name, value, next(sigmas)) for name, value in side) for side in unknowns.plain_values(fit.parameters)
    )
    motion = covariance[-6:, -6:]
    along = found.T_upper_lower[:3, 3] / np.linalg.norm(found.T_upper_lower[:3, 3])
    return RigCalibration(
        found.lower,
        found.upper,
        found.T_upper_lower,
        printed[0],
        tuple(good),
        fit,
        parameters,
        np.sqrt(np.maximum(0, np.diag(motion))),
        float(np.sqrt(along @ motion[:3, :3] @ along)),
        covariance,
        tuple(rejected),
        printed[1].moved(fit.board_steps),
        isinstance(unknowns.parameterisations[0], TelecentricMirror),
    )
