"""Calibration by ten real images of a mirror camera, compared with OCamCalib's corners, polynomial, centre, errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.board_finder import find_board
from calib.fit.boards.camera_fit import CameraCalibration, fit_camera, refine_camera_calibration
from calib.fit.boards.camera_models import Model
from calib.fit.boards.unified_start import unified_from_ocam
from calib.models.camera import Array
from calib.models.ocam import OcamCamera

BOTH: tuple[Model, Model] = ("ocam", "omni")
BOARD = Board(6, 7, 0.03)
SIZE = (1024, 768)
Images = dict[str, NDArray[np.uint8]]


def read_images(shared_data: Path) -> Images:
    paths = sorted((shared_data / "vmr_board").glob("*.jpg"))
    return {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint8) for path in paths}


def reference(shared_data: Path, key: str) -> tuple[dict[str, Any], list[BoardView], Array]:
    """Return OCamCalib's numbers, its corners as views, and its errors by image."""
    numbers = json.loads((shared_data / "vmr_board" / "reference.json").read_text())[key]
    views = [
        BoardView(entry["image"], np.column_stack([entry["col_1based"], entry["row_1based"]]) - 1.0)
        for entry in numbers["images"]
    ]
    # From the toolbox's order of corners to Board.points: x varies fastest.
    order = np.lexsort((numbers["Xt_mm"], numbers["Yt_mm"]))
    reordered = [BoardView(view.name, view.pixels[order]) for view in views]
    return numbers, reordered, np.array(numbers["stored_errMean_px"])


def ray_angles_deg(ocam: CameraCalibration, omni: CameraCalibration) -> Array:
    """Return angles between the rays of both cameras at the corners."""
    assert isinstance(ocam.camera, OcamCamera)
    pixels = np.concatenate([view.pixels for view in ocam.views])
    one, other = ocam.camera.lift(pixels) @ unified_from_ocam(ocam.camera)[:3, :3].T, omni.camera.lift(pixels)
    return np.asarray(np.rad2deg(np.linalg.norm(one - other, axis=1)))


@pytest.mark.slow
def test_both_models_fit_real_images_and_are_consistent(shared_data: Path) -> None:
    images = read_images(shared_data)
    views = [found.view for name, image in images.items() if (found := find_board(image, BOARD, name)).view]
    assert len(views) == 10
    known = [view for view in views if view]
    ocam, omni = (
        refine_camera_calibration(fit_camera(known, BOARD, SIZE, model), images, model, "mirror") for model in BOTH
    )
    assert ocam.rejected == omni.rejected == ()
    assert ocam.fit.mean_px < 0.285 and omni.fit.mean_px < 0.285
    assert ray_angles_deg(ocam, omni).max() < 0.1


@pytest.mark.parametrize(
    ("key", "mean_px", "apart_deg"),
    [pytest.param("ocam_std", 0.4705, 0.35, marks=pytest.mark.slow), ("ocam_subpix", 0.305, 0.2)],
)
def test_fits_the_toolbox_corners_with_less_error_than_the_toolbox(
    shared_data: Path, key: str, mean_px: float, apart_deg: float
) -> None:
    numbers, views, errors = reference(shared_data, key)
    found = fit_camera(views, BOARD, SIZE)
    assert found.fit.mean_px < mean_px < numbers["stored_mean_err_px"]
    assert (found.view_errors_px < errors * 1.15).all()
    assert isinstance(found.camera, OcamCamera)
    row, column = found.camera.center_row_column
    assert (row + 1, column + 1) == pytest.approx((numbers["xc_row_1based"], numbers["yc_col_1based"]), abs=2.0)
    radius = np.linspace(100, 350, 26)
    theirs = np.polynomial.polynomial.polyval(radius, numbers["ss"])
    ours = found.camera.height(radius)
    assert np.rad2deg(np.abs(np.arctan2(ours, radius) - np.arctan2(theirs, radius))).max() < apart_deg
