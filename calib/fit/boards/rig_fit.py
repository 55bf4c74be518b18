"""Calibration of one camera, or of a rig of two and the transform between them, by boards that they see at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import AS_DRAWN, AnyBoard, PrintShape
from calib.boards.local_mapping import refine_with_camera
from calib.errors import CalibError
from calib.fit.boards.bundle import TWIST_NAMES, BoardFit, BoardRig, fit_boards
from calib.fit.boards.start import LinearCamera, initialise_relative_pose, solve_linear
from calib.fit.least_squares import BEST_STEP, central_differences
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View
from calib.rig import SIDES, TRANSFORM_NAMES, Rig, RigCovariance
from calib.validation import LineReporter, silent

# With four views the median of their errors still shows which one is wrong; fewer are not enough for that.
MIN_VIEWS: Final = 4
# A view is an outlier if its error exceeds this ratio of the views' median, and this error in pixels, or rays of the
# linear solution: with exact corners the ratio alone would reject views for differences of no importance.
BAD_RATIO, BAD_PX, BAD_RAD = 4.0, 0.25, 0.01
# Larger mean errors mean that the images do not show one board at one time: right ones have 0.05 to 0.15 px.
MAX_MEAN_PX: Final = 3.0
Images = Mapping[str, NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class PairView:
    """The views of a board at one instant by each camera; None: a camera does not see it.

    A view is the pixels (N, 2) of the corners in the order of the board's points, NaN for unknown ones.
    """

    name: str
    seen: tuple[Array | None, ...]

    @property
    def is_seen(self) -> bool:
        """True if a camera sees the board."""
        return any(view is not None for view in self.seen)


@dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that was left out, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """A calibrated camera, or a pair of them, and the views that it was fitted to."""

    fit: BoardFit
    board: AnyBoard
    views: tuple[PairView, ...]  # K
    rejected: tuple[RejectedView, ...] = ()

    @property
    def cameras(self) -> tuple[OcamCamera, ...]:
        """Return the cameras, the lower one first."""
        return self.fit.rig.cameras

    @property
    def T_upper_lower(self) -> Array:
        """Return the transform (4, 4) between the cameras."""
        return self.fit.rig.T_upper_lower

    @property
    def baseline_m(self) -> float:
        """Return the distance of the viewpoints [m]."""
        return float(np.linalg.norm(se3.t_of(self.T_upper_lower)))

    @property
    def motion_covariance(self) -> Array:
        """Return the covariance (6, 6) of T_upper_lower, translation [m] and rotation [rad], in the upper frame."""
        first = len(self.fit.rig.names) * len(self.cameras)
        return self.fit.covariance[first : first + len(TWIST_NAMES), first : first + len(TWIST_NAMES)]

    @property
    def baseline_sigma_m(self) -> float:
        """Return the standard deviation of the distance of the viewpoints [m]."""
        along = se3.t_of(self.T_upper_lower) / self.baseline_m
        return float(np.sqrt(along @ self.motion_covariance[:3, :3] @ along))

    @property
    def pairs(self) -> int:
        """Return the number of instants at which all cameras saw the board."""
        return _pairs(self.views)


def calibrate_boards(
    views: Sequence[PairView],
    board: AnyBoard,
    sizes: Sequence[tuple[int, int]],
    view: View = "mirror",
    images: Sequence[Images] = (),
    progress: LineReporter = silent,
) -> RigCalibration:
    """Calibrate one camera or two, and the transform between them, by views of a board; outlier views are rejected.

    sizes: (width, height) [px] of each camera's images. images: those of each camera by the views' names, in which the
    corners are refined by the calibrated cameras; none: they stay. CalibError where fewer than MIN_VIEWS views of a
    camera, or pairs of both, are consistent.
    """
    # 1. Each camera by its own views: a linear solution, then the most likely camera. What fits neither is left out.
    views, rejected, alone = list(views), list[RejectedView](), list[RigCalibration]()
    for side, size in enumerate(sizes):
        own = [PairView(one.name, (one.seen[side],)) for one in views if one.seen[side] is not None]
        progress(f"{SIDES[side]} camera: fitting {len(own)} views")
        good, bad, solved = consistent_views(own, board, size, view)
        start = BoardRig((solved.camera(size, view),), np.eye(4), solved.T_cam_board, AS_DRAWN, np.zeros(1))
        found = _without_outliers(start, good, board)
        found = replace(found, rejected=(*bad, *found.rejected))
        alone.append(found)
        where = f"{SIDES[side]} camera: " if len(sizes) > 1 else ""
        rejected += [RejectedView(bad.name, where + bad.reason) for bad in found.rejected]
        bad_names = {bad.name for bad in found.rejected}
        for k, one in enumerate(views):
            if one.name in bad_names:
                views[k] = replace(one, seen=(*one.seen[:side], None, *one.seen[side + 1 :]))
        views = [one for one in views if one.is_seen]
    # 2. The transform between the cameras, and all together.
    if len(sizes) == 1:
        found = replace(alone[0], rejected=())
    else:
        progress(f"rig: fitting {_pairs(views)} pairs")
        found = _fit_pair(views, board, alone)
    rejected += found.rejected
    # 3. The corners again, by the calibrated cameras: twice, since they are moved by what the cameras lacked.
    for _ in range(2 if images else 0):
        progress("refining the corners")
        found = _without_outliers(found.fit.rig, refined_views(found, images), board)
        rejected += found.rejected
    # 4. Mirrors below telecentric lenses, where these are more likely.
    if view == "mirror":
        with suppress(CalibError, np.linalg.LinAlgError):
            fit = fit_boards(found.fit.rig, _pixels(found.views, board), board, telecentric=True)
            found = replace(found, fit=fit) if fit.is_likelier(found.fit) else found
    return replace(found, rejected=tuple(rejected))


def refined_views(found: RigCalibration, images: Sequence[Images]) -> list[PairView]:
    """Return the views with their corners moved onto those of the images, by the calibrated cameras."""
    poses = found.fit.rig.transforms()

    def refined(k: int, side: int) -> Array | None:
        view, camera = found.views[k], found.cameras[side]
        pixels = view.seen[side]
        if pixels is None:
            return None
        return refine_with_camera(images[side][view.name], pixels, found.board, camera, poses[side][k])

    return [
        PairView(view.name, tuple(refined(k, side) for side in range(len(view.seen))))
        for k, view in enumerate(found.views)
    ]


def consistent_views(
    views: Sequence[PairView], board: AnyBoard, size: tuple[int, int], view: View
) -> tuple[list[PairView], list[RejectedView], LinearCamera]:
    """Reject views of one camera with large errors in the linear solution, the worst first; it affects the others."""
    _require(len(views), "views of the board")
    good, rejected = list(views), list[RejectedView]()
    while True:
        _require(len(good), "consistent views", rejected)
        solved = solve_linear(_pixels(good, board)[:, 0], board.points, size, view)
        worst, usual = int(np.argmax(solved.errors_rad)), float(np.median(solved.errors_rad))
        if solved.errors_rad[worst] <= max(BAD_RATIO * min(usual, BAD_RAD), BAD_RAD):
            return good, rejected, solved
        reason = (
            f"its corners lie {np.rad2deg(solved.errors_rad[worst]):.1f} deg or more off any board, the others "
            f"{np.rad2deg(usual):.2f}"
        )
        rejected.append(RejectedView(good.pop(worst).name, reason))


def rig_covariance(found: RigCalibration, rig: Rig) -> RigCovariance:
    """Return the covariance of a calibration's parameters for its rig."""
    names = [f"{side} {name}" for side in SIDES for name in found.fit.rig.names]

    def moves(twist: Array) -> Array:
        """Return the moves (6,) TRANSFORM_NAMES of the upper camera by a twist of T_upper_lower."""
        T_upper_rig = se3.exp(twist) @ rig.upper.T_cam_rig
        return rig.moves_to(replace(rig, upper=replace(rig.upper, T_cam_rig=T_upper_rig)))

    count = len(names) + len(TWIST_NAMES)
    J = np.eye(count)
    J[len(names) :, len(names) :] = central_differences(moves, BEST_STEP * np.ones(len(TWIST_NAMES)))
    return RigCovariance.of_matrix([*names, *TRANSFORM_NAMES], J @ found.fit.covariance[:count, :count] @ J.T)


def _fit_pair(views: Sequence[PairView], board: AnyBoard, alone: Sequence[RigCalibration]) -> RigCalibration:
    """Fit two cameras and the transform between them."""
    _require(_pairs(views), "instants at which both cameras saw the board")
    cameras = (alone[0].cameras[0], alone[1].cameras[0])
    numbers = {view.name: k for k, view in enumerate(views)}
    lower, upper = (
        {numbers[view.name]: T for view, T in zip(one.views, one.fit.rig.T_lower_board, strict=True)} for one in alone
    )
    initial = initialise_relative_pose(lower, upper)
    rejected = [RejectedView(views[k].name, reason) for k, reason in initial.rejected]
    good = [views[k] for k in initial.T_lower_board]
    _require(_pairs(good), "consistent pairs of views", rejected)
    shape = PrintShape(tuple(np.mean([one.fit.rig.shape.values for one in alone], axis=0).tolist()))
    start = BoardRig(cameras, initial.T_upper_lower, np.array([*initial.T_lower_board.values()]), shape, np.zeros(2))
    found = _without_outliers(start, good, board)
    if found.fit.mean_px > MAX_MEAN_PX:
        raise CalibError(
            f"calibrate rig: the corners are {found.fit.mean_px:.1f} px off any rig, expected {MAX_MEAN_PX:.0f} "
            "at most; did the cameras see the board at the same time?"
        )
    return replace(found, rejected=(*rejected, *found.rejected))


def _without_outliers(start: BoardRig, views: Sequence[PairView], board: AnyBoard) -> RigCalibration:
    """Fit cameras to views; as long as views fit much worse than the others, leave out these, a third at most."""
    good, rejected = list(views), list[RejectedView]()
    while True:
        fit = fit_boards(start, _pixels(good, board), board)
        errors = np.nanmedian(fit.errors_px.reshape(len(good), -1), axis=1)
        bad = errors > max(BAD_RATIO * float(np.median(errors)), BAD_PX)
        bad[np.argsort(-errors)[max(1, len(errors) // 3) :]] = False
        if not bad.any():
            return RigCalibration(fit, board, tuple(good), tuple(rejected))
        rejected += [
            RejectedView(good[k].name, f"its corners are {errors[k]:.2f} px off, the others {np.median(errors):.2f} px")
            for k in np.flatnonzero(bad)
        ]
        good = [view for view, is_bad in zip(good, bad, strict=True) if not is_bad]
        _require(_pairs(good), "consistent pairs of views", rejected)
        start = replace(fit.rig, T_lower_board=fit.rig.T_lower_board[~bad])


def _pixels(views: Sequence[PairView], board: AnyBoard) -> Array:
    """Return the corners (K, C, N, 2) of views, NaN for those that a camera does not see."""
    none = np.full((len(board.points), 2), np.nan)
    return np.array([[none if seen is None else seen for seen in view.seen] for view in views])


def _pairs(views: Sequence[PairView]) -> int:
    """Return the number of instants at which all cameras saw the board."""
    return sum(all(seen is not None for seen in view.seen) for view in views)


def _require(count: int, what: str, rejected: Sequence[RejectedView] = ()) -> None:
    if count < MIN_VIEWS:
        left_out = "".join(f"; left out {bad.name}: {bad.reason}" for bad in rejected[:3])
        raise CalibError(
            f"calibrate: expected at least {MIN_VIEWS} {what}, found {count}{left_out}; hold the board where each "
            "camera sees it whole, on all sides, near and tilted"
        )
