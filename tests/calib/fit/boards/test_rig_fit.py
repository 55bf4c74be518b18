"""Calibration by corners: one camera and rigs, sigmas, bent boards, real mirrors, ambiguous and inconsistent views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.board import AS_DRAWN, Board, BoardView, PrintShape, ambiguous_orders
from calib.errors import CalibError
from calib.fit.boards.bundle import fit_boards
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards, rig_covariance
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.names import values_of
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig, rig_between
from tests.bench.calibration import board_rig, projected_views
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
ODD, EVEN, SQUARE = Board(7, 6, 0.03), Board(8, 6, 0.03), Board(6, 6, 0.03)
OCAM = OcamCamera((-131.6, 0.0, 1.9e-3, 0.0, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE)
DIRECT = OcamCamera((-190.0, 0.0, 1.2e-3, 0.0, 4e-10), (380.9, 394.2), (1.001, -3e-4, -3e-4), SIZE, "direct")
PINHOLE = UnifiedCamera(0.0, (400.0, 401.5), (394.2, 380.9), SIZE)


def pairs(
    board: Board, count: int = 10, noise_px: float = 0.0, seed: int = 0, shape: PrintShape = AS_DRAWN
) -> list[PairView]:
    rng, made, points = np.random.default_rng(seed), [], shape.points(board.points)
    for k, T in enumerate(board_poses_around_rig(RIG, board, count, seed=seed)):
        both = [m.camera.project(se3.apply(m.T_cam_rig @ T, points)) for m in (RIG.lower, RIG.upper)]
        lower, upper = (BoardView(f"p{k}", pixels + noise_px * rng.standard_normal(pixels.shape)) for pixels in both)
        made.append(PairView(f"p{k}", (lower, upper)))
    return made


def calibrated(views: list[PairView], board: Board = ODD) -> RigCalibration:
    return calibrate_boards(views, board, [SIZE, SIZE])


def off(found: RigCalibration) -> tuple[float, float]:
    """Return the errors of the rotation [deg] and of the viewpoint [mm]."""
    gap = se3.inverse(T_TRUE) @ found.T_upper_lower
    return float(np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3])))), float(1e3 * np.linalg.norm(gap[:3, 3]))


@pytest.mark.parametrize("board", [EVEN, SQUARE])
def test_recovers_the_rig_for_every_orientation_of_the_boards(board: Board) -> None:
    orders = ambiguous_orders(board)
    assert len(orders) == {EVEN: 2, SQUARE: 4}[board]
    views = []
    for k, view in enumerate(pairs(board)):
        lower, upper = view.seen
        assert upper
        views.append(replace(view, seen=(lower, replace(upper, pixels=upper.pixels[orders[k % len(orders)]]))))
    found = calibrated(views, board)
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
        PairView(f"view{k}", (BoardView(f"view{k}", pixels + noise_px * rng.standard_normal(pixels.shape)),))
        for k, pixels in enumerate(seen)
    ]


@pytest.mark.parametrize("truth", [OCAM, DIRECT, PINHOLE])
def test_recovers_one_camera_of_any_kind(truth: OmniCamera) -> None:
    view = "direct" if truth in (DIRECT, PINHOLE) else "mirror"
    found = calibrate_boards(one_sided(truth), ODD, [SIZE], "direct" if view == "direct" else "mirror").cameras[0]
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
    turn = np.array([se3.log(rig.T_upper_lower @ se3.inverse(T_TRUE))[3:] / rig.motion_sigma[3:] for rig in rigs])
    assert np.sqrt(np.mean(baseline**2)) < 1.6 and 0.4 < np.sqrt(np.mean(turn**2)) < 1.4


def test_views_that_do_not_fit_are_rejected_by_name() -> None:
    views = pairs(ODD, 12, noise_px=0.05)
    lower, upper = views[3].seen
    views[3] = replace(views[3], seen=(lower, views[4].seen[1]))
    rng = np.random.default_rng(1)
    lower, upper = views[6].seen
    assert lower
    views[6] = replace(views[6], seen=(replace(lower, pixels=rng.uniform(100, 600, lower.pixels.shape)), upper))
    found = calibrated(views)
    reasons = {bad.name: bad.reason for bad in found.rejected}
    assert sorted(reasons) == ["p3", "p6"] and "was the board moving?" in reasons["p3"]
    assert reasons["p6"].startswith("lower camera: its corners lie") and found.pairs == 10
    assert any(view.seen[0] is None for view in found.views)


def test_refuses_too_few_views_and_pairs() -> None:
    with pytest.raises(CalibError, match="expected at least 4 views of the board, found 3; hold the board"):
        calibrated(pairs(ODD)[:3])
    exchanged = [
        replace(view, seen=(view.seen[0], pairs(ODD, 10, seed=9)[k].seen[1])) for k, view in enumerate(pairs(ODD)[:5])
    ]
    with pytest.raises(CalibError, match="expected at least 4 consistent pairs of views"):
        calibrated(exchanged)


@pytest.mark.parametrize(
    "shape",
    [
        AS_DRAWN,
        PrintShape((0.8e-3, -0.5e-3, 0.3e-3, 0.0)),
        PrintShape((3e-3, 0.0, 0.0, 0.003)),
    ],
)
def test_the_shape_of_the_print_is_found_and_leaves_the_rig_as_it_is(shape: PrintShape) -> None:
    found = calibrated(pairs(ODD, 14, 0.01, shape=shape))
    np.testing.assert_allclose(found.shape.values[:3], shape.values[:3], atol=4e-5)
    assert found.shape.stretch == pytest.approx(shape.stretch, abs=4 * np.sqrt(found.fit.covariance[-1, -1]))
    assert found.fit.mean_px < 0.014 and off(found)[0] < 0.02 and off(found)[1] < 0.3


def profile_sigmas(found: RigCalibration) -> Array:
    """Return the standard deviations of a4 and w_s of both cameras, which boards show together only."""
    return np.array([[side["a4"], side["w_s"]] for side in sigmas_of(found)])


@pytest.mark.slow
def test_boards_of_paraboloids_give_the_profile_of_the_mirrors_twice_as_well() -> None:
    truth, perfect = board_rig(21, 1.0)
    board = Board(5, 4, 0.08)
    found = calibrate_boards(
        projected_views(truth, perfect, board, 12, 0.015, seed=21, noise_seed=[3]), board, [truth.lower.camera.size] * 2
    )
    assert found.telecentric and not found.structure(0).is_misfit
    pixels = np.array([[seen.pixels for seen in view.seen if seen] for view in found.views])
    free = replace(found, fit=fit_boards(found.fit.rig, pixels, board))
    assert (profile_sigmas(found) < 0.7 * profile_sigmas(free)).all()
    rig = rig_between(found.cameras[0], found.cameras[1], se3.inverse(found.T_upper_lower))
    covariance = rig_covariance(found, rig)
    assert {"lower w_s", "upper a4", "baseline"} < set(covariance.names)
    assert abs(rig.baseline_m - truth.baseline_m) < 4 * covariance.sigma("baseline") < 1e-3
