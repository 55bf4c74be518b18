"""Calibration of a camera: exact and noisy corners, standard deviations, rejected views, rendered boards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board, BoardView
from calib.errors import CalibError
from calib.fit.boards.camera_fit import fit_camera
from calib.models.camera import Mask, OmniCamera
from calib.models.ocam import OcamCamera, View
from calib.models.unified import UnifiedCamera
from tests.simulation.boards import board_poses_around_camera

BOARD = Board(7, 6, 0.03)
MASK = Mask((394.2, 380.9), 60.0, 372.0)
SIZE = (780, 768)
OMNI = UnifiedCamera(0.93, (-205.0, 206.2), MASK.center, SIZE)
BENT = UnifiedCamera(1.1, (-230.0, 231.0), MASK.center, SIZE, (-0.02, 0.004, 1e-3, -2e-3))
PINHOLE = UnifiedCamera(0.0, (400.0, 401.5), MASK.center, SIZE)
LENS = UnifiedCamera(1.4, (330.0, 331.5), MASK.center, SIZE)
OCAM = OcamCamera((-131.6, 0.0, 1.9e-3, 9e-8, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE)
DIRECT = OcamCamera((-190.0, 0.0, 1.2e-3, -2e-7, 4e-10), (380.9, 394.2), (1.001, -3e-4, -3e-4), SIZE, "direct")


def seen_by(camera: OmniCamera, count: int = 10, noise_px: float = 0.0, seed: int = 0) -> list[BoardView]:
    axis = camera.lift(np.array([camera.center]))[0]
    elevation = (35.0, 100.0) if axis[2] > 0 else (95.0, 150.0)
    if camera is LENS:
        elevation = (10.0, 75.0)
    distance_m = (0.12, 0.3)
    if camera is PINHOLE:
        elevation, distance_m = (10.0, 25.0), (0.3, 0.5)
    rng = np.random.default_rng(seed)
    poses = board_poses_around_camera(
        camera, BOARD, MASK, count, seed=seed, distance_m=distance_m, elevation_deg=elevation
    )
    return [
        BoardView(f"view{k}", camera.project(se3.apply(T, BOARD.points)) + noise_px * rng.standard_normal((42, 2)))
        for k, T in enumerate(poses)
    ]


def turned_apart_rad(one: OmniCamera, other: OmniCamera) -> float:
    """Return the largest angle between two cameras' rays after alignment of their frames."""
    pixels = np.array(
        [(394 + r * np.cos(a), 381 + r * np.sin(a)) for r in np.linspace(80, 340, 9) for a in np.arange(0, 6.2, 0.5)]
    )
    a, b = one.lift(pixels), other.lift(pixels)
    seen = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    a, b = a[seen], b[seen]
    left, _, right = np.linalg.svd(a.T @ b)
    return float(np.linalg.norm(a - b @ (left @ right).T, axis=1).max())


@pytest.mark.parametrize("truth", [OCAM, DIRECT])
def test_recovers_the_ocam_camera_from_exact_corners(truth: OcamCamera) -> None:
    found = fit_camera(seen_by(truth), BOARD, SIZE, "ocam", truth.view).camera
    assert isinstance(found, OcamCamera) and found.view == truth.view
    assert found.center_row_column == pytest.approx(truth.center_row_column, abs=1e-3)
    assert found.affine == pytest.approx(truth.affine, abs=1e-6)
    assert found.polynomial[0] == pytest.approx(truth.polynomial[0], rel=1e-5)
    assert turned_apart_rad(found, truth) < 1e-5


@pytest.mark.parametrize(("truth", "view"), [(OMNI, "mirror"), (BENT, "mirror"), (LENS, "direct"), (PINHOLE, "direct")])
def test_recovers_the_omni_camera_from_exact_corners(truth: UnifiedCamera, view: View) -> None:
    found = fit_camera(seen_by(truth), BOARD, SIZE, "omni", view).camera
    assert isinstance(found, UnifiedCamera)
    assert found.xi == pytest.approx(truth.xi, abs=1e-3)
    assert found.focal == pytest.approx(truth.focal, rel=1e-3)
    assert found.center == pytest.approx(truth.center, abs=0.01)
    assert found.distortion == pytest.approx(truth.distortion, abs=3e-4)
    assert turned_apart_rad(found, truth) < 1e-5


@pytest.mark.slow
def test_sigmas_are_consistent_with_errors() -> None:
    """Errors divided by their sigmas are about normal, over parameters and repetitions."""
    truth = {"a0": -131.6, "a2": 1.9e-3, "center_row": 380.9, "center_column": 394.2, "c": 0.998, "d = e": 2e-4}
    ratios = []
    for seed in range(4):
        found = fit_camera(seen_by(OCAM, noise_px=0.2, seed=seed), BOARD, SIZE)
        known = {name: (value, sigma) for name, value, sigma in found.parameters}
        ratios += [(known[name][0] - value) / known[name][1] for name, value in truth.items()]
        assert found.fit.mean_px == pytest.approx(0.2 * np.sqrt(np.pi / 2), rel=0.1)
    assert 0.6 < np.std(ratios) < 1.6 and np.abs(ratios).max() < 4


def spoilt(views: list[BoardView]) -> list[BoardView]:
    rng = np.random.default_rng(1)
    shaken = replace(views[2], pixels=views[2].pixels + rng.normal(0, 3, (42, 2)))
    nonsense = replace(views[6], pixels=rng.uniform(100, 600, (42, 2)))
    return [*views[:2], shaken, *views[3:6], nonsense, *views[7:]]


@pytest.mark.slow
def test_rejects_outlier_views_by_name() -> None:
    found = fit_camera(spoilt(seen_by(OMNI, noise_px=0.1)), BOARD, SIZE, "omni")
    assert sorted(bad.name for bad in found.rejected) == ["view2", "view6"]
    assert all("off" in bad.reason for bad in found.rejected)
    assert len(found.views) == len(found.fit.T_cam_board) == 8
    assert turned_apart_rad(found.camera, OMNI) < 5e-3


def test_refuses_too_few_views() -> None:
    views = seen_by(OMNI)
    with pytest.raises(CalibError, match="expected at least 4 views of the board, found 3; take more"):
        fit_camera(views[:3], BOARD, SIZE)
    with pytest.raises(CalibError, match="expected at least 4 consistent views, found 3; left out view2"):
        fit_camera([views[0], views[4], spoilt(views)[2], views[8]], BOARD, SIZE)
