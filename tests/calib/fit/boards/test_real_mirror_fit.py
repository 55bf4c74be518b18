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
from calib.boards.checkerboard import find_board
from calib.fit.boards.rig_fit import PairView, calibrate_boards
from calib.models.camera import Array

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


def one_sided(views: list[BoardView]) -> list[PairView]:
    return [PairView(view.name, (view,)) for view in views]


@pytest.mark.slow
def test_a_real_mirror_is_fitted_to_a_quarter_of_a_pixel(shared_data: Path) -> None:
    images = read_images(shared_data)
    views = [view for name, image in images.items() if (view := find_board(image, BOARD, name)) is not None]
    assert len(views) == 10
    found = calibrate_boards(one_sided(views), BOARD, [SIZE], "mirror", [images])
    assert found.rejected == () and found.fit.mean_px < 0.25 and not found.structure(0).is_misfit


@pytest.mark.parametrize(
    ("key", "mean_px", "apart_deg"),
    [pytest.param("ocam_std", 0.4705, 0.35, marks=pytest.mark.slow), ("ocam_subpix", 0.305, 0.2)],
)
def test_fits_the_toolbox_corners_with_less_error_than_the_toolbox(
    shared_data: Path, key: str, mean_px: float, apart_deg: float
) -> None:
    numbers, views, errors = reference(shared_data, key)
    found = calibrate_boards(one_sided(views), BOARD, [SIZE])
    assert found.fit.mean_px < mean_px < numbers["stored_mean_err_px"]
    assert (np.nanmean(found.fit.errors_px[:, 0], axis=1) < errors * 1.15).all()
    row, column = found.cameras[0].center_row_column
    assert (row + 1, column + 1) == pytest.approx((numbers["xc_row_1based"], numbers["yc_col_1based"]), abs=3.0)
    radius = np.linspace(100, 350, 26)
    theirs = np.polynomial.polynomial.polyval(radius, numbers["ss"])
    ours = found.cameras[0].height(radius)
    assert np.rad2deg(np.abs(np.arctan2(ours, radius) - np.arctan2(theirs, radius))).max() < apart_deg
