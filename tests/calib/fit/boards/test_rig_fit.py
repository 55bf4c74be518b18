"""Calibration by corners: one camera and rigs, sigmas, bent boards, real mirrors, inconsistent views."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import AS_DRAWN, Board, PrintShape
from calib.boards.checkerboard import find_board
from calib.errors import CalibError
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.names import values_of
from calib.models.ocam import OcamCamera, View
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from tests.simulation.boards import board_poses_around_camera, board_poses_around_rig

SIZE = (780, 768)
LOWER = UnifiedCamera(1.0, (-205.0, 206.2), (394.2, 380.9), SIZE)
UPPER = UnifiedCamera(0.97, (-207.0, 206.2), (391.2, 382.9), SIZE)
T_UPPER_LOWER = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])
RIG = Rig(
    MountedCamera(LOWER, np.eye(4), Mask(LOWER.center, 60.0, 372.0)),
    MountedCamera(UPPER, T_UPPER_LOWER, Mask(UPPER.center, 60.0, 372.0)),
)
# Frames of unified cameras have x against u, those of ocam cameras x down the rows.
T_OMNI_OCAM = se3.transform(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
T_TRUE = se3.inverse(T_OMNI_OCAM) @ T_UPPER_LOWER @ T_OMNI_OCAM
ODD = Board(7, 6, 0.03)
OCAM = OcamCamera((-131.6, 0.0, 1.9e-3, 0.0, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE)
DIRECT = OcamCamera((-190.0, 0.0, 1.2e-3, 0.0, 4e-10), (380.9, 394.2), (1.001, -3e-4, -3e-4), SIZE, "direct")
PINHOLE = UnifiedCamera(0.0, (400.0, 401.5), (394.2, 380.9), SIZE)


def pairs(
    board: Board, count: int = 10, noise_px: float = 0.0, seed: int = 0, shape: PrintShape = AS_DRAWN
) -> list[PairView]:
    rng, made, points = np.random.default_rng(seed), [], shape.points(board.points)
    for k, T in enumerate(board_poses_around_rig(RIG, board, count, seed=seed)):
        both = [m.camera.project(se3.apply(m.T_cam_rig @ T, points)) for m in (RIG.lower, RIG.upper)]
        lower, upper = (pixels + noise_px * rng.standard_normal(pixels.shape) for pixels in both)
        made.append(PairView(f"p{k}", (lower, upper)))
    return made


def calibrated(views: list[PairView], board: Board = ODD) -> RigCalibration:
    return calibrate_boards(views, board, [SIZE, SIZE])


def off(found: RigCalibration) -> tuple[float, float]:
    """Return the errors of the rotation [deg] and of the viewpoint [mm]."""
    gap = se3.inverse(T_TRUE) @ found.T_upper_lower
    return float(np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3])))), float(1e3 * np.linalg.norm(gap[:3, 3]))


def test_the_fit_recovers_the_rig() -> None:
    found = calibrated(pairs(ODD))
    assert off(found)[0] < 0.01 and off(found)[1] < 0.15 and found.pairs == 10 and found.rejected == ()
    assert found.cameras[0].center == pytest.approx(LOWER.center, abs=0.01)


def one_sided(camera: OmniCamera, noise_px: float = 0.0, seed: int = 0) -> list[PairView]:
    """Return views of one camera."""
    elevation, distance_m = ((95.0, 150.0), (0.12, 0.3))
    if camera.lift(np.array([camera.center]))[0, 2] > 0:
        elevation = (35.0, 100.0)
    if camera is PINHOLE:
        elevation, distance_m = (10.0, 25.0), (0.3, 0.5)
    poses = board_poses_around_camera(
        camera, ODD, RIG.lower.visible, 10, seed=seed, distance_m=distance_m, elevation_deg=elevation
    )
    rng, seen = np.random.default_rng(seed), [camera.project(se3.apply(T, ODD.points)) for T in poses]
    return [
        PairView(f"view{k}", (pixels + noise_px * rng.standard_normal(pixels.shape),)) for k, pixels in enumerate(seen)
    ]


@pytest.mark.parametrize("truth", [OCAM, DIRECT, PINHOLE])
def test_the_fit_recovers_one_camera_of_any_kind(truth: OmniCamera) -> None:
    view: View = "direct" if truth in (DIRECT, PINHOLE) else "mirror"
    found = calibrate_boards(one_sided(truth), ODD, [SIZE], view).cameras[0]
    angles, radii = np.meshgrid(np.arange(0, 6.2, 0.5), np.linspace(80, 340, 9))
    pixels = np.column_stack([(394 + radii * np.cos(angles)).ravel(), (381 + radii * np.sin(angles)).ravel()])
    a, b = found.lift(pixels), truth.lift(pixels)
    left, _, right = np.linalg.svd(a.T @ b)
    assert np.linalg.norm(a - b @ (left @ right).T, axis=1).max() < 1e-4
    assert found.view == view and found.center == pytest.approx(truth.center, abs=0.02)


def sigmas_of(found: RigCalibration) -> list[dict[str, float]]:
    """Return the standard deviations of the parameters of each camera by name."""
    names, sigmas = found.fit.rig.names, np.sqrt(np.diag(found.fit.covariance))
    parts = np.split(sigmas[: len(names) * len(found.cameras)], len(found.cameras))
    return [dict(zip(names, part.tolist(), strict=True)) for part in parts]


@pytest.mark.slow
def test_sigmas_are_consistent_with_errors() -> None:
    """Errors divided by their sigmas are about normal, over parameters and repetitions."""
    truth = {"a0": -131.6, "a2": 1.9e-3, "center_row": 380.9, "center_column": 394.2, "c": 0.998, "d": 2e-4}
    ratios, rigs = [], []
    for seed in range(6):
        one = calibrate_boards(one_sided(OCAM, 0.2, seed), ODD, [SIZE])
        found, sigmas = values_of(one.cameras[0]), sigmas_of(one)[0]
        ratios += [(found[name] - value) / sigmas[name] for name, value in truth.items()]
        rigs.append(calibrated(pairs(ODD, noise_px=0.1, seed=seed)))
    assert np.std(ratios) < 1.6 and np.abs(ratios).max() < 4
    length = float(np.linalg.norm(T_TRUE[:3, 3]))
    baseline = np.array([(rig.baseline_m - length) / rig.baseline_sigma_m for rig in rigs])
    turn_sigmas = np.array([np.sqrt(np.diag(rig.motion_covariance)[3:]) for rig in rigs])
    turn = np.array([se3.log(rig.T_upper_lower @ se3.inverse(T_TRUE))[3:] for rig in rigs]) / turn_sigmas
    assert np.sqrt(np.mean(baseline**2)) < 1.6 and 0.4 < np.sqrt(np.mean(turn**2)) < 1.4


def test_views_that_do_not_fit_are_rejected_by_name() -> None:
    views = pairs(ODD, 12, noise_px=0.05)
    lower, upper = views[3].seen
    views[3] = replace(views[3], seen=(lower, views[4].seen[1]))
    rng = np.random.default_rng(1)
    lower, upper = views[6].seen
    assert lower is not None
    views[6] = replace(views[6], seen=(rng.uniform(100, 600, lower.shape), upper))
    found = calibrated(views)
    reasons = {bad.name: bad.reason for bad in found.rejected}
    assert sorted(reasons) == ["p3", "p6"] and "was the board moving?" in reasons["p3"]
    assert reasons["p6"].startswith("lower camera: its corners lie") and found.pairs == 10
    assert any(view.seen[0] is None for view in found.views)


def test_too_few_views_and_pairs_are_refused() -> None:
    with pytest.raises(CalibError, match="expected at least 4 views of the board, found 3; hold the board"):
        calibrated(pairs(ODD)[:3])
    exchanged = [
        replace(view, seen=(view.seen[0], pairs(ODD, 10, seed=9)[k].seen[1])) for k, view in enumerate(pairs(ODD)[:5])
    ]
    with pytest.raises(CalibError, match="expected at least 4 consistent pairs of views"):
        calibrated(exchanged)


@pytest.mark.parametrize(
    "shape",
    [AS_DRAWN, PrintShape((3e-3, 0.0, 0.0, 0.003))],
)
def test_the_shape_of_the_print_is_found_and_leaves_the_rig_as_it_is(shape: PrintShape) -> None:
    found = calibrated(pairs(ODD, 14, 0.01, shape=shape))
    np.testing.assert_allclose(found.fit.rig.shape.values[:3], shape.values[:3], atol=4e-5)
    assert found.fit.rig.shape.stretch == pytest.approx(shape.stretch, abs=4 * np.sqrt(found.fit.covariance[-1, -1]))
    assert found.fit.mean_px < 0.014 and off(found)[0] < 0.02 and off(found)[1] < 0.3


# Ten real images of a mirror, compared with OCamCalib's corners, polynomial, centre and errors


BOARD = Board(6, 7, 0.03)
REAL_SIZE = (1024, 768)
Images = dict[str, NDArray[np.uint8]]


def read_images(shared_data: Path) -> Images:
    paths = sorted((shared_data / "vmr_board").glob("*.jpg"))
    return {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint8) for path in paths}


def reference(shared_data: Path, key: str) -> tuple[dict[str, Any], list[PairView], Array]:
    """Return OCamCalib's numbers, its corners as views, and its errors by image."""
    numbers = json.loads((shared_data / "vmr_board" / "reference.json").read_text())[key]
    # From the toolbox's order of corners to Board.points: x varies fastest.
    order = np.lexsort((numbers["Xt_mm"], numbers["Yt_mm"]))
    views = [
        PairView(entry["image"], (np.column_stack([entry["col_1based"], entry["row_1based"]])[order] - 1.0,))
        for entry in numbers["images"]
    ]
    return numbers, views, np.array(numbers["stored_errMean_px"])


@pytest.mark.slow
def test_a_real_mirror_is_fitted_to_a_quarter_of_a_pixel(shared_data: Path) -> None:
    images = read_images(shared_data)
    views = [PairView(name, (find_board(image, BOARD),)) for name, image in images.items()]
    assert len(views) == 10 and all(view.is_seen for view in views)
    found = calibrate_boards(views, BOARD, [REAL_SIZE], "mirror", [images])
    assert found.rejected == () and found.fit.mean_px < 0.25


@pytest.mark.parametrize(
    ("key", "mean_px", "apart_deg"),
    [pytest.param("ocam_std", 0.4705, 0.35, marks=pytest.mark.slow), ("ocam_subpix", 0.305, 0.2)],
)
def test_the_fit_has_less_error_at_the_toolbox_corners_than_the_toolbox(
    shared_data: Path, key: str, mean_px: float, apart_deg: float
) -> None:
    numbers, views, errors = reference(shared_data, key)
    found = calibrate_boards(views, BOARD, [REAL_SIZE])
    assert found.fit.mean_px < mean_px < numbers["stored_mean_err_px"]
    assert (np.nanmean(found.fit.errors_px[:, 0], axis=1) < errors * 1.15).all()
    row, column = found.cameras[0].center_row_column
    assert (row + 1, column + 1) == pytest.approx((numbers["xc_row_1based"], numbers["yc_col_1based"]), abs=3.0)
    radius = np.linspace(100, 350, 26)
    theirs = np.polynomial.polynomial.polyval(radius, numbers["ss"])
    ours = found.cameras[0].height_and_slope(radius)[0]
    assert np.rad2deg(np.abs(np.arctan2(ours, radius) - np.arctan2(theirs, radius))).max() < apart_deg
