"""From boards that two cameras saw at once to the transform between them, all of it adjusted together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board, BoardView
from calib.boards.corner_refinement import refine_with
from calib.errors import CalibError
from calib.fit.bundle import Adjusted, Observed, adjust
from calib.fit.camera_fit import Rejected, bad_views
from calib.fit.parameterisation import CameraParameters, nudge
from calib.fit.rig_initialisation import Agreed, Seen, agree
from calib.models.camera import Array, OmniCamera

MIN_PAIRS = 4
MAX_REJECTIONS = 10
# Corners that fit no better than this, on average, are no views of one board by these cameras.
MAX_MEAN_PX = 3.0
MOTION_NAMES = ("t_x", "t_y", "t_z", "r_x", "r_y", "r_z")
Images = Mapping[str, NDArray[np.uint8]]
Sides = tuple[OmniCamera, OmniCamera]  # of the lower and the upper camera


@dataclass(frozen=True, slots=True)
class PairView:
    """A board as both cameras saw it at one instant, or only one of them."""

    name: str
    seen: Seen  # by the lower and the upper camera


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """Two cameras and T_upper_lower; fit has residuals (K, 2N, 2), the lower camera's first, and T_lower_board."""

    lower: OmniCamera
    upper: OmniCamera
    T_upper_lower: Array  # (4, 4)
    board: Board
    views: tuple[PairView, ...]
    fit: Adjusted
    parameters: tuple[tuple[tuple[str, float, float], ...], ...]  # of lower and upper: name, value, deviation
    motion_sigma: Array  # (6,) deviations of T_upper_lower, translation [m] and rotation [rad], in the upper frame
    baseline_sigma_m: float
    rejected: tuple[Rejected, ...] = ()

    @property
    def baseline_m(self) -> float:
        """Distance of the viewpoints [m]."""
        return float(np.linalg.norm(self.T_upper_lower[:3, 3]))

    @property
    def pairs(self) -> int:
        """How many instants both cameras saw the board."""
        return sum(map(_is_pair, self.views))

    def side_errors_px(self, side: int) -> Array:
        """Mean reprojection error (K,) of every view in the lower (0) or upper (1) camera; NaN where it has none."""
        errors = np.split(self.fit.errors_px, 2, axis=1)[side]
        known = np.isfinite(errors)
        return np.where(known.any(axis=1), np.nansum(errors, axis=1) / np.maximum(known.sum(axis=1), 1), np.nan)


@dataclass(frozen=True, slots=True)
class _PairCamera:
    """Both cameras as one: of every 2N points of a view the first N are seen by the lower, the others by the upper."""

    lower: OmniCamera
    upper: OmniCamera
    T_upper_lower: Array
    corners: int

    def project(self, points: Array) -> Array:
        """Pixels (M, 2) of points (M, 3) in the lower camera's frame."""
        both = points.reshape(-1, 2, self.corners, 3)
        lower = self.lower.project(both[:, 0].reshape(-1, 3))
        upper = self.upper.project(se3.apply(self.T_upper_lower, both[:, 1].reshape(-1, 3)))
        return np.stack([pixels.reshape(-1, self.corners, 2) for pixels in (lower, upper)], axis=1).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class _Unknowns:
    """What is solved for: steps of both cameras, where they are not taken as they are, and of the motion between."""

    nudges: tuple[CameraParameters, CameraParameters]
    refined: bool
    T_upper_lower: Array
    units: Array  # (6,) of a motion's steps
    corners: int

    @property
    def ends(self) -> tuple[int, int, int]:
        """Where the parts end: lower, upper, motion."""
        lower, upper = (len(side.names) if self.refined else 0 for side in self.nudges)
        return lower, lower + upper, lower + upper + 6

    def camera(self, steps: Array) -> _PairCamera:
        """Both cameras, so many steps away."""
        lower, upper, _ = self.ends
        cameras = (self.nudges[0].at(steps[:lower]), self.nudges[1].at(steps[lower:upper])) if self.refined else (
            self.nudges[0].base, self.nudges[1].base)
        return _PairCamera(*cameras, se3.exp(steps[upper:] * self.units) @ self.T_upper_lower, self.corners)


def calibrate_rig(views: Sequence[PairView], board: Board, cameras: Sides, refined: bool = True) -> RigCalibration:
    """The transform between two cameras, and themselves if refined, that fit all views best; bad views are named.

    cameras are where the search starts, or how they stay. Raises CalibError where fewer than MIN_PAIRS pairs agree, or
    where the pairs leave open how the board was turned.
    """
    _require(sum(_is_pair(view) for view in views), "instants at which both cameras saw the board")
    agreed = agree([view.seen for view in views], board, cameras)
    rejected = [Rejected(views[k].name, reason) for k, reason in agreed.rejected]
    good, T_lower_board = _ordered(views, agreed, refined)
    fit, unknowns = _solve(good, board, (cameras, refined), (agreed.T_upper_lower, T_lower_board))
    for _ in range(MAX_REJECTIONS):
        bad = bad_views(fit)
        if not bad.any():
            break
        rejected += [_too_far(good[k], fit, k) for k in np.flatnonzero(bad).tolist()]
        good = [view for view, is_bad in zip(good, bad, strict=True) if not is_bad]
        _require(sum(map(_is_pair, good)), "pairs of views that agree", rejected)
        found = unknowns.camera(fit.parameters)
        fit, unknowns = _solve(good, board, ((found.lower, found.upper) if refined else cameras, refined),
                               (found.T_upper_lower, fit.T_cam_board[~bad]))
    if fit.mean_px > MAX_MEAN_PX:
        raise CalibError(f"calibrate rig: the corners are {fit.mean_px:.1f} px off any rig, expected {MAX_MEAN_PX:.0f} "
                         "at most; did the cameras see the board at the same time, are their files the right ones?")
    return _concluded(good, board, (fit, unknowns), rejected)


def sharpened_rig(found: RigCalibration, images: tuple[Images, Images], refined: bool = True) -> RigCalibration:
    """The rig from corners looked at anew through the cameras that it found; images by the views' names.

    Of an instant that one camera saw alone there need be no image of the other.
    """
    cameras = (found.lower, found.upper)
    poses = (found.fit.T_cam_board, found.T_upper_lower @ found.fit.T_cam_board)
    views = []
    for k, view in enumerate(found.views):
        lower, upper = (seen and _sharper(seen, images[side][view.name], cameras[side], (poses[side][k], found.board))
                        for side, seen in enumerate(view.seen))
        views.append(PairView(view.name, (lower, upper)))
    again = calibrate_rig(views, found.board, cameras, refined)
    return replace(again, rejected=found.rejected + again.rejected)


def _sharper(seen: BoardView, image: NDArray[np.uint8], camera: OmniCamera, place: tuple[Array, Board]) -> BoardView:
    T_cam_board, board = place
    return replace(seen, pixels=refine_with(image, camera, T_cam_board, (board, seen.pixels)))


def _is_pair(view: PairView) -> bool:
    return None not in view.seen


def _require(count: int, what: str, rejected: Sequence[Rejected] = ()) -> None:
    if count < MIN_PAIRS:
        left_out = "".join(f"; left out {bad.name}: {bad.reason}" for bad in rejected[:3])
        raise CalibError(f"calibrate rig: needs {MIN_PAIRS} {what} at least, found {count}{left_out}; hold the board "
                         "where both cameras see it whole, on all sides and tilted")


def _ordered(views: Sequence[PairView], agreed: Agreed, refined: bool) -> tuple[list[PairView], Array]:
    """The views that agree, the upper corners in the lower ones' order, and their boards (K, 4, 4); singles say
    something of the cameras only."""
    kept = [k for k in agreed.T_lower_board if refined or _is_pair(views[k])]
    good = [_turned(views[k], agreed.orders.get(k)) for k in kept]
    _require(sum(map(_is_pair, good)), "pairs of views that agree",
             [Rejected(views[k].name, reason) for k, reason in agreed.rejected])
    return good, np.array([agreed.T_lower_board[k] for k in kept])


def _turned(view: PairView, order: NDArray[np.intp] | None) -> PairView:
    lower, upper = view.seen
    return view if upper is None or order is None else replace(
        view, seen=(lower, replace(upper, pixels=upper.pixels[order])))


def _solve(good: Sequence[PairView], board: Board, given: tuple[Sides, bool], start: tuple[Array, Array]
           ) -> tuple[Adjusted, _Unknowns]:
    """Bundle adjustment of both cameras, the motion between them and one pose of the board for every view."""
    (lower, upper), refined = given
    T_upper_lower, T_lower_board = start
    reach = float(np.median(np.linalg.norm(T_lower_board[:, :3, 3], axis=1)))
    units = np.repeat([reach, 1.0], 3) / (min(lower.size) / 4)  # of about a pixel's effect
    unknowns = _Unknowns((nudge(lower), nudge(upper)), refined, T_upper_lower, units, len(board.points))
    none = np.full((len(board.points), 2), np.nan)
    pixels = np.array([np.concatenate([none if seen is None else seen.pixels for seen in view.seen])
                       for view in good])
    observed = Observed(pixels, np.tile(board.points, (2, 1)))
    return adjust(unknowns.camera, np.zeros(unknowns.ends[-1]), T_lower_board, observed), unknowns


def _too_far(view: PairView, fit: Adjusted, k: int) -> Rejected:
    errors = np.nanmedian(fit.errors_px, axis=1)
    return Rejected(view.name, f"its corners are {errors[k]:.2f} px off, the others {np.median(errors):.2f} px")


def _concluded(good: Sequence[PairView], board: Board, solved: tuple[Adjusted, _Unknowns],
               rejected: Sequence[Rejected]) -> RigCalibration:
    fit, unknowns = solved
    found, (lower, upper, _) = unknowns.camera(fit.parameters), unknowns.ends
    sigma = np.sqrt(np.maximum(0, np.diag(fit.covariance)))
    parts = ((0, lower), (lower, upper))
    parameters = tuple(tuple(side.values(fit.parameters[a:b], sigma[a:b])) if unknowns.refined else ()
                       for side, (a, b) in zip(unknowns.nudges, parts, strict=True))
    motion = fit.covariance[upper:, upper:] * np.outer(unknowns.units, unknowns.units)
    along = found.T_upper_lower[:3, 3] / np.linalg.norm(found.T_upper_lower[:3, 3])
    return RigCalibration(found.lower, found.upper, found.T_upper_lower, board, tuple(good), fit, parameters,
                          np.sqrt(np.maximum(0, np.diag(motion))), float(np.sqrt(along @ motion[:3, :3] @ along)),
                          tuple(rejected))
