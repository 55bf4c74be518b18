"""From the boards in a camera's images to the camera: which views are good, which model terms earn their place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.corner_refinement import refine_with
from calib.errors import CalibError
from calib.fit.bundle import Adjusted, Observed
from calib.fit.ocam_fit import DEGREE, fit_ocam, ocam_maker, ocam_values, raise_degree
from calib.fit.ocam_linear import solve_linear
from calib.fit.unified_fit import TERMS, fit_unified, unified_maker, unified_values
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera, View

Model = Literal["ocam", "omni"]
MODELS: tuple[Model, Model] = ("ocam", "omni")
MIN_VIEWS = 4
# A view is bad when its error is so many times the usual one, and more than what good corners may have.
BAD_RATIO, BAD_PX = 3.0, 0.25
BAD_LINEAR_RATIO, BAD_LINEAR_RAD = 5.0, 0.01
MAX_REJECTIONS = 10
# A term is taken in when it takes this part off the error. What gains less may as well stand for a mirror that is not
# quite central, and bends rays by tenths of a degree to do so.
WORTH = 0.1
HIGHER_DEGREES = (5, 6)
# What gives rise to a warning: few of so many directions, or a parameter known no better than this.
SECTORS, MIN_SECTORS = 12, 9
MAX_SCALE_DEVIATION, MAX_CENTER_DEVIATION_PX = 0.005, 1.0
MAX_MEAN_PX = 1.0
CENTER_NAMES = ("center_row", "center_column", "pu", "pv")


@dataclass(frozen=True, slots=True)
class Rejected:
    """A view that was left out, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera, how it was found and how sure it is; fit holds the poses and residuals of views, in their order."""

    camera: OmniCamera
    board: Board
    views: tuple[BoardView, ...]
    fit: Adjusted
    parameters: tuple[tuple[str, float, float], ...]  # name, value, standard deviation
    rejected: tuple[Rejected, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def view_errors_px(self) -> Array:
        """Mean reprojection error (K,) of every view."""
        return np.asarray(np.nanmean(self.fit.errors_px, axis=1))


@dataclass(frozen=True, slots=True)
class _Solved:
    camera: OmniCamera
    fit: Adjusted
    parameters: tuple[tuple[str, float, float], ...]


_Solve = Callable[[Observed], _Solved]


def calibrate(views: Sequence[BoardView], board: Board, size: tuple[int, int], model: Model = "ocam",
              view: View = "mirror") -> Calibration:
    """The camera that fits the views best; views of boards that no camera fits are left out and named.

    size (width, height) [px]. Raises CalibError where fewer than MIN_VIEWS are good.
    """
    _require(len(views), "views of the board")
    good, rejected = _plausible(list(views), board, size, view)

    def solve(observed: Observed) -> _Solved:
        ocam = _ocam(observed, size, view)
        return ocam if model == "ocam" else _omni(observed, ocam)

    solved = solve(_observed(good, board))
    for _ in range(MAX_REJECTIONS):
        bad = bad_views(solved.fit)
        if not bad.any():
            break
        rejected += [_too_far(seen, solved.fit, k) for k, seen in enumerate(good) if bad[k]]
        good = [seen for k, seen in enumerate(good) if not bad[k]]
        _require(len(good), "views that agree", rejected)
        solved = solve(_observed(good, board))
    warnings = _warnings(solved, _observed(good, board))
    return Calibration(solved.camera, board, tuple(good), solved.fit, solved.parameters, tuple(rejected), warnings)


def sharpened(found: Calibration, images: Mapping[str, NDArray[np.uint8]], model: Model, view: View) -> Calibration:
    """The calibration from corners looked at anew through the camera that it found; images by the views' names."""
    views = [replace(seen, pixels=refine_with(images[seen.name], found.camera, T, (found.board, seen.pixels)))
             for seen, T in zip(found.views, found.fit.T_cam_board, strict=True)]
    again = calibrate(views, found.board, found.camera.size, model, view)
    return replace(again, rejected=found.rejected + again.rejected)


def _observed(views: Sequence[BoardView], board: Board) -> Observed:
    return Observed(np.array([view.pixels for view in views]), board.points)


def _require(count: int, what: str, rejected: Sequence[Rejected] = ()) -> None:
    if count < MIN_VIEWS:
        left_out = "".join(f"; left out {bad.name}: {bad.reason}" for bad in rejected[:3])
        raise CalibError(f"calibrate: needs {MIN_VIEWS} {what} at least, found {count}{left_out}; take more images, "
                         "with the board all around the camera, near, and tilted")


def _plausible(views: list[BoardView], board: Board, size: tuple[int, int],
               view: View) -> tuple[list[BoardView], list[Rejected]]:
    """The views without those that the linear solution finds far off: the worst goes first, as it spoils the others."""
    good, rejected = list(views), list[Rejected]()
    while True:
        _require(len(good), "views that agree", rejected)
        errors = solve_linear(_observed(good, board), size, DEGREE, view).errors_rad
        worst, usual = int(np.argmax(errors)), float(np.median(errors))
        if errors[worst] <= max(BAD_LINEAR_RATIO * min(usual, BAD_LINEAR_RAD), BAD_LINEAR_RAD):
            return good, rejected
        rejected.append(Rejected(good.pop(worst).name, f"its corners lie {np.rad2deg(errors[worst]):.1f} deg or more "
                                 f"off any board, the others {np.rad2deg(usual):.2f}"))


def bad_views(fit: Adjusted) -> NDArray[np.bool_]:
    """Which views (K,) are off by much more than the others, by most of their corners; the worst third at most."""
    errors = np.nanmedian(fit.errors_px, axis=1)
    bad = errors > max(BAD_RATIO * float(np.median(errors)), BAD_PX)
    bad[np.argsort(-errors)[max(1, len(errors) // 3):]] = False
    return np.asarray(bad)


def _too_far(view: BoardView, fit: Adjusted, k: int) -> Rejected:
    errors = np.nanmedian(fit.errors_px, axis=1)
    return Rejected(view.name, f"its corners are {errors[k]:.2f} px off, the others {np.median(errors):.2f} px")


def _ocam(observed: Observed, size: tuple[int, int], view: View) -> _Solved:
    """The ocam camera of the lowest degree that no higher one beats by much."""
    best = trial = _solved_ocam(fit_ocam(observed, size, view), DEGREE, (size, view))
    for degree in HIGHER_DEGREES:
        assert isinstance(trial.camera, OcamCamera)
        trial = _solved_ocam(raise_degree(trial.fit, observed, trial.camera), degree, (size, view))
        best = trial if _worth(best.fit, trial.fit) else best
    return best


def _solved_ocam(fit: Adjusted, degree: int, seen: tuple[tuple[int, int], View]) -> _Solved:
    size, view = seen
    return _Solved(ocam_maker(size, view, degree)(fit.parameters), fit, tuple(ocam_values(fit, size, degree)))


def _omni(observed: Observed, ocam: _Solved) -> _Solved:
    """The omni camera with the fewest distortion terms that no more of them beat by much."""
    assert isinstance(ocam.camera, OcamCamera)
    best, terms = fit_unified(observed, ocam.camera, ocam.fit.T_cam_board, 0), 0
    for more in TERMS[1:]:
        trial = fit_unified(observed, ocam.camera, ocam.fit.T_cam_board, more)
        if _worth(best, trial):
            best, terms = trial, more
    size = ocam.camera.size
    return _Solved(unified_maker(size, terms)(best.parameters), best, tuple(unified_values(best, size, terms)))


def _worth(best: Adjusted, trial: Adjusted) -> bool:
    return trial.mean_px < (1 - WORTH) * best.mean_px


def _warnings(solved: _Solved, observed: Observed) -> tuple[str, ...]:
    """What makes the camera doubtful, one line each."""
    said = []
    sectors = _sectors(observed.pixels, solved.camera.center)
    if sectors < MIN_SECTORS:
        said.append(f"corners were seen in {sectors} of {SECTORS} directions only: hold the board on all sides")
    if solved.fit.mean_px > MAX_MEAN_PX:
        said.append(f"the error of {solved.fit.mean_px:.2f} px is large: is the board flat, is the image sharp, is "
                    "--view right?")
    deviation = {name: (value, sigma) for name, value, sigma in solved.parameters}
    scale, sigma = deviation["a0" if "a0" in deviation else "fu"]
    if sigma > MAX_SCALE_DEVIATION * abs(scale):
        said.append(f"the scale is known to {100 * sigma / abs(scale):.1f} % only: tilt the board, bring it nearer")
    if max(deviation[name][1] for name in CENTER_NAMES if name in deviation) > MAX_CENTER_DEVIATION_PX:
        said.append("the centre is known to more than a pixel only: hold the board on all sides of the camera")
    return tuple(said)


def _sectors(pixels: Array, center: tuple[float, float]) -> int:
    """In how many of SECTORS directions from the centre corners were seen."""
    offset = (pixels - center).reshape(-1, 2)
    offset = offset[np.isfinite(offset[:, 0])]
    direction = np.arctan2(offset[:, 1], offset[:, 0])
    return len(np.unique(np.floor((direction + np.pi) / (2 * np.pi) * SECTORS * 0.999999)))
