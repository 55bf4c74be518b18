"""The cameras of a rig, each fitted to its own views of a board: where the fit of the rig starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

from calib.boards.print_shape import PrintShape
from calib.camera_file import CameraFile
from calib.fit.boards.camera_fit import RejectedView
from calib.fit.boards.camera_selection import ModelChoice, refine_selection, select_calibration
from calib.fit.boards.rig_problem import PairView, Sides
from calib.models.ocam import OcamCamera, View
from omnid.calibration.board_search import AnyBoard
from omnid.calibration.camera import report_scores
from omnid.calibration.image_pairs import SIDES, PairedImages
from omnid.calibration.progress import Progress


@dataclass(frozen=True, slots=True)
class FittedCameras:
    """Both cameras, each by its own views; polynomials: cameras from which the terms of real mirrors are fitted."""

    cameras: Sides
    polynomials: tuple[OcamCamera, OcamCamera] | None
    views: list[PairView]  # without the rejected ones
    rejected: tuple[RejectedView, ...]

    @staticmethod
    def known(files: tuple[CameraFile, CameraFile], views: list[PairView]) -> FittedCameras:
        """Return cameras that are known before."""
        return FittedCameras((files[0].camera, files[1].camera), None, views, ())


def fit_cameras(
    images: PairedImages,
    board: AnyBoard,
    model: ModelChoice,
    direction: View,
    progress: Progress,
    views: list[PairView],
    shape: PrintShape,
) -> FittedCameras:
    """Fit each camera to all its views; views that do not fit their camera are rejected.

    The corners are refined with the cameras the first time, when the print is taken to be as drawn.
    """
    cameras, polynomials, rejected = [], list[OcamCamera](), list[RejectedView]()
    for side, name in enumerate(SIDES):
        seen = [own for view in views if (own := view.seen[side]) is not None]
        height, width = images.sides[side][seen[0].name].shape if seen else (0, 0)
        selected = select_calibration(seen, board, (width, height), model, direction, shape)
        report_scores(selected, f"{name} camera", progress)
        if shape.is_as_drawn:
            selected = refine_selection(selected, images.sides[side], direction)
        found = selected.calibration
        cameras.append(found.camera)
        if selected.polynomial is not None:
            polynomials.append(selected.polynomial)
        rejected += [RejectedView(bad.name, f"{name} camera: {bad.reason}") for bad in found.rejected]
        views = _without(views, side, {bad.name for bad in found.rejected})
    general = (polynomials[0], polynomials[1]) if model == "auto" and len(polynomials) == len(SIDES) else None
    return FittedCameras((cameras[0], cameras[1]), general, views, tuple(rejected))


def _without(views: list[PairView], side: int, names: set[str]) -> list[PairView]:
    """Remove one camera's views of the named instants; the other camera's views are kept."""
    kept = [
        view
        if view.name not in names
        else replace(view, seen=(None, view.seen[1]) if side == 0 else (view.seen[0], None))
        for view in views
    ]
    return [view for view in kept if any(view.seen)]
