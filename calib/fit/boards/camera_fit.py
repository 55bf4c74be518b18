"""Calibration of a camera from board views: rejection of outlier views, choice of the number of model terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView, CalibrationBoard
from calib.boards.corner_refinement import refine_with_camera
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.errors import CalibError
from calib.fit.boards.bundle import BundleResult, Observations
from calib.fit.boards.camera_models import DEGREE, FittedModel, Model, fit_model, refit
from calib.fit.boards.ocam_linear import solve_linear
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import View

# With four views the median of their errors still shows which one is wrong; fewer are not enough for that.
MIN_VIEWS = 4
# A view is an outlier if its median error exceeds this ratio of the views' median, and this error in pixels: with exact
# corners the ratio alone would reject views for differences of no importance.
BAD_RATIO, BAD_PX = 3.0, 0.25
# The same for the mean ray error of the linear solution, which is larger because that solution has no affine terms and
# its centre is that of a grid search.
BAD_LINEAR_RATIO, BAD_LINEAR_RAD = 5.0, 0.01
# A bound for the loop. Each round rejects at most a third of the views, so it ends earlier for lack of views.
MAX_REJECTIONS = 10
# Limits for warnings: directions with corners, relative sigma of the scale, sigma of the centre, mean error.
SECTORS, MIN_SECTORS = 12, 9
MAX_SCALE_SIGMA, MAX_CENTER_SIGMA_PX = 0.005, 1.0
MAX_MEAN_PX = 1.0
# The angle pi belongs to the last sector, and rounding must not make it one more.
BELOW_ONE = 0.999999
CENTER_NAMES = ("center_row", "center_column", "pu", "pv")


@dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that was left out, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """A calibrated camera; fit holds the poses and residuals of the views, in their order."""

    camera: OmniCamera
    board: CalibrationBoard
    views: tuple[BoardView, ...]
    fit: BundleResult
    parameters: tuple[tuple[str, float, float], ...]  # name, value, standard deviation
    rejected: tuple[RejectedView, ...] = ()
    warnings: tuple[str, ...] = ()
    shape: PrintShape = AS_DRAWN

    @property
    def view_errors_px(self) -> Array:
        """Return the mean reprojection error (K,) of every view."""
        return np.asarray(np.nanmean(self.fit.errors_px, axis=1))


def fit_camera(
    views: Sequence[BoardView],
    board: CalibrationBoard,
    size: tuple[int, int],
    model: Model = "ocam",
    view: View = "mirror",
    shape: PrintShape = AS_DRAWN,
) -> CameraCalibration:
    """Fit a camera to board views; outlier views are rejected.

    size (width, height) [px]. shape: start value of the print's shape, whose free modes are fitted. Raises CalibError
    if fewer than MIN_VIEWS remain.
    """
    good, rejected = consistent_views(views, board, size, view)
    return calibrate_consistent(good, rejected, board, size, model, view, shape=shape)


def calibrate_consistent(
    views: Sequence[BoardView],
    rejected: Sequence[RejectedView],
    board: CalibrationBoard,
    size: tuple[int, int],
    model: Model,
    view: View,
    ocam: FittedModel | None = None,
    shape: PrintShape = AS_DRAWN,
) -> CameraCalibration:
    """Fit a camera to views of which the inconsistent ones have been rejected; see fit_camera.

    ocam: the ocam camera fitted to the same views, if it is known, as the start of the other models.
    """
    solved = fit_model(model, observations(views, board, shape), size, view, ocam)
    return _without_outliers(solved, views, rejected, board, shape, lambda seen: fit_model(model, seen, size, view))


def _without_outliers(
    solved: FittedModel,
    views: Sequence[BoardView],
    rejected: Sequence[RejectedView],
    board: CalibrationBoard,
    shape: PrintShape,
    fit_again: Callable[[Observations], FittedModel],
) -> CameraCalibration:
    """Return the calibration of a fit, which is repeated without the views that fit much worse than the others."""
    good, rejected = list(views), list(rejected)
    for _ in range(MAX_REJECTIONS):
        bad = outlier_views(solved.fit)
        if not bad.any():
            break
        rejected += [rejected_view(seen.name, solved.fit, k) for k, seen in enumerate(good) if bad[k]]
        good = [seen for k, seen in enumerate(good) if not bad[k]]
        _require(len(good), "consistent views", rejected)
        solved = fit_again(observations(good, board, shape))
    warnings = _warnings(solved, observations(good, board))
    return CameraCalibration(
        solved.camera,
        board,
        tuple(good),
        solved.fit,
        solved.parameters,
        tuple(rejected),
        warnings,
        shape.moved(solved.fit.board_steps),
    )


def refine_camera_calibration(
    found: CameraCalibration, images: Mapping[str, NDArray[np.uint8]], model: Model, view: View
) -> CameraCalibration:
    """Refine the corners with the calibrated camera, and fit its parameters again; images by the views' names."""
    views = [
        replace(seen, pixels=refine_with_camera(images[seen.name], seen.pixels, found.board, found.camera, T))
        for seen, T in zip(found.views, found.fit.T_cam_board, strict=True)
    ]
    names = [name for name, _, _ in found.parameters]
    again = refit(found.camera, names, found.fit.T_cam_board, observations(views, found.board, found.shape))
    size = found.camera.size
    return _without_outliers(
        again, views, found.rejected, found.board, found.shape, lambda seen: fit_model(model, seen, size, view)
    )


def observations(
    views: Sequence[BoardView], board: CalibrationBoard, shape: PrintShape = AS_DRAWN, *, fixed: bool = False
) -> Observations:
    """Return the observed corners of views of a print of a board, whose free modes are unknowns unless fixed."""
    modes = None if fixed else shape.modes(board.points)
    return Observations(np.array([view.pixels for view in views]), shape.points(board.points), modes=modes)


def _require(count: int, what: str, rejected: Sequence[RejectedView] = ()) -> None:
    if count < MIN_VIEWS:
        left_out = "".join(f"; left out {bad.name}: {bad.reason}" for bad in rejected[:3])
        raise CalibError(
            f"calibrate: expected at least {MIN_VIEWS} {what}, found {count}{left_out}; take more images, "
            "with the board all around the camera, near, and tilted"
        )


def consistent_views(
    views: Sequence[BoardView], board: CalibrationBoard, size: tuple[int, int], view: View
) -> tuple[list[BoardView], list[RejectedView]]:
    """Reject views with large errors in the linear solution, the worst first, because it affects the others."""
    _require(len(views), "views of the board")
    good, rejected = list(views), list[RejectedView]()
    while True:
        _require(len(good), "consistent views", rejected)
        errors = solve_linear(observations(good, board), size, DEGREE, view).errors_rad
        worst, usual = int(np.argmax(errors)), float(np.median(errors))
        if errors[worst] <= max(BAD_LINEAR_RATIO * min(usual, BAD_LINEAR_RAD), BAD_LINEAR_RAD):
            return good, rejected
        reason = (
            f"its corners lie {np.rad2deg(errors[worst]):.1f} deg or more off any board, the others "
            f"{np.rad2deg(usual):.2f}"
        )
        rejected.append(RejectedView(good.pop(worst).name, reason))


def outlier_views(fit: BundleResult) -> NDArray[np.bool_]:
    """Return the mask (K,) of views whose median error is far above that of the others; at most the worst third."""
    errors = np.nanmedian(fit.errors_px, axis=1)
    bad = errors > max(BAD_RATIO * float(np.median(errors)), BAD_PX)
    bad[np.argsort(-errors)[max(1, len(errors) // 3) :]] = False
    return np.asarray(bad)


def rejected_view(name: str, fit: BundleResult, k: int) -> RejectedView:
    """Return view k of a fit, which has that name, as one that is an outlier."""
    errors = np.nanmedian(fit.errors_px, axis=1)
    return RejectedView(name, f"its corners are {errors[k]:.2f} px off, the others {np.median(errors):.2f} px")


def _warnings(solved: FittedModel, observed: Observations) -> tuple[str, ...]:
    """Return one line for every property that limits the calibration."""
    warnings = []
    sectors = _covered_sectors(observed.pixels, solved.camera.center)
    if sectors < MIN_SECTORS:
        warnings.append(f"corners were seen in {sectors} of {SECTORS} directions only: hold the board on all sides")
    if solved.fit.mean_px > MAX_MEAN_PX:
        warnings.append(
            f"the error of {solved.fit.mean_px:.2f} px is large: check that the board is flat, the images "
            "are sharp, and --view is right"
        )
    values = {name: (value, sigma) for name, value, sigma in solved.parameters}
    scale, sigma = values["a0" if "a0" in values else "fu"]
    if sigma > MAX_SCALE_SIGMA * abs(scale):
        warnings.append(
            f"the scale has a standard deviation of {100 * sigma / abs(scale):.1f} %: tilt the board, bring it nearer"
        )
    if max(values[name][1] for name in CENTER_NAMES if name in values) > MAX_CENTER_SIGMA_PX:
        warnings.append("the centre has a standard deviation above a pixel: hold the board on all sides of the camera")
    return tuple(warnings)


def _covered_sectors(pixels: Array, center: tuple[float, float]) -> int:
    """Return the number of SECTORS directions from the centre in which corners were seen."""
    offset = (pixels - center).reshape(-1, 2)
    offset = offset[np.isfinite(offset[:, 0])]
    direction = np.arctan2(offset[:, 1], offset[:, 0])
    return len(np.unique(np.floor((direction + np.pi) / (2 * np.pi) * SECTORS * BELOW_ONE)))
