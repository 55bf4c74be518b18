"""Bundle adjustment of a camera and the poses of a board: robust, with a prior, with uncertainties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib import se3
from calib.fit.boards.bundle import LOST_PX, Observations, Prior, adjust_bundle, residuals
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from tests.calib.fit.boards.seen_boards import BOARD, OCAM, observed_boards


def moved_center(steps: Array) -> OcamCamera:
    """Return the camera with its centre moved [px]."""
    row, column = OCAM.center_row_column
    return replace(OCAM, center_row_column=(row + steps[0], column + steps[1]))


def disturbed(poses: Array) -> Array:
    return np.asarray(se3.exp(0.01 * np.random.default_rng(5).standard_normal((len(poses), 6))) @ poses)


def test_parameters_and_poses_are_found() -> None:
    poses, observed = observed_boards()
    found = adjust_bundle(moved_center, np.array([2.0, -3.0]), disturbed(poses), observed)
    assert np.abs(found.parameters).max() < 1e-3 and found.mean_px < 1e-3
    assert np.allclose(found.T_cam_board, poses, atol=1e-5)


def test_outliers_have_little_effect_and_sigmas_are_those_of_the_noise() -> None:
    poses, observed = observed_boards(noise_px=0.2)
    wrong = observed.pixels.copy()
    wrong[2, 5] += 40.0
    plain = adjust_bundle(moved_center, np.zeros(2), poses, observed)
    found = adjust_bundle(moved_center, np.zeros(2), poses, replace(observed, pixels=wrong))
    sigma = np.sqrt(np.diag(plain.covariance))
    assert (np.abs(plain.parameters) < 4 * sigma).all() and (np.abs(found.parameters - plain.parameters) < sigma).all()
    assert found.errors_px[2, 5] > 30


def test_a_prior_keeps_a_parameter_at_its_centre() -> None:
    poses, observed = observed_boards(noise_px=0.2)
    prior = Prior(np.array([5.0, 0.0]), np.array([1e-6, np.inf]))
    found = adjust_bundle(moved_center, np.zeros(2), poses, observed, prior=prior)
    assert abs(found.parameters[0] - 5.0) < 1e-3 and abs(found.parameters[1]) < 1.0


def test_corners_that_are_not_projected_are_far_and_unknown_ones_count_nothing() -> None:
    poses, observed = observed_boards(3)
    pixels = observed.pixels.copy()
    pixels[0, 0] = np.nan
    behind = poses.copy()
    behind[1, :3, 3] = np.nan
    found = residuals(OCAM, behind, Observations(pixels, BOARD.points), BOARD.points)
    assert np.isnan(found[0, 0]).all() and (found[1] == LOST_PX).all() and np.abs(found[2]).max() < 1e-6


def test_modes_of_the_board_are_found() -> None:
    poses, _ = observed_boards()
    modes = np.zeros((len(BOARD.points), 3, 1))
    modes[:, 2, 0] = (BOARD.points[:, 0] - BOARD.points[:, 0].mean()) ** 2
    bent = BOARD.points + 0.5 * modes[..., 0]
    pixels = np.array([OCAM.project(se3.apply(T, bent)) for T in poses])
    found = adjust_bundle(lambda _: OCAM, np.zeros(0), poses, Observations(pixels, BOARD.points, modes=modes))
    assert abs(found.board_steps[0] - 0.5) < 1e-3 and found.mean_px < 1e-3
