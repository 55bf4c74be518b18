"""Patches are warped as a plane in the scene is, and located to hundredths of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.patch_alignment import (
    affine_warps,
    align,
    align_rows,
    disparity_slopes,
    view_noise,
    warped_templates,
)
from omnid.core.odometry.patch_fit import TEMPLATE_PX
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.core.stereo.triangulation import view
from tests.omnid.core.scenery import texture, wrapped

Array = NDArray[np.float64]

CYLINDER = Cylinder(1200, 360, 130.0)
MODEL = StereoModel(CYLINDER, 0.2)
NORMAL, DISTANCE_M = np.array([0.6, 0.8, 0.0]), 1.5  # an upright wall, askew
MOVED = se3.exp([0.25, -0.1, 0.02, 0, 0.01, 0.3])  # T_curr_ref


def on_the_wall(pixels: Array) -> Array:
    """Return the intersections (N, 3) of the rays of pixels (N, 2) with the wall."""
    rays = CYLINDER.rays(pixels)
    return np.asarray(rays * (DISTANCE_M / (rays @ NORMAL))[:, None])


def wall_views(pixels: Array) -> Array:
    return view(on_the_wall(pixels), CYLINDER, MODEL.baseline_m)


def moved(pixels: Array) -> Array:
    """Return the pixels (N, 2) of the same points of the wall after the motion."""
    return CYLINDER.pixels(se3.apply(MOVED, on_the_wall(pixels)))


PIXELS = np.array([[420.3, 100.0], [380.0, 150.5], [460.0, 90.2], [400.0, 200.0]])


def wall_slopes() -> Array:
    def disparity(pixels: Array) -> Array:
        views = wall_views(pixels)
        return np.asarray(views[:, 2] - views[:, 1])

    return np.column_stack([(disparity(PIXELS + step) - disparity(PIXELS - step)) / 2 for step in np.eye(2)])


def test_the_warp_is_the_derivative_of_the_projection_of_the_wall() -> None:
    across, down = (moved(PIXELS + step) - moved(PIXELS - step) for step in (np.array([0.5, 0]), np.array([0, 0.5])))
    truth = np.stack([across, down], axis=2)
    warps = affine_warps(wall_views(PIXELS), wall_slopes(), np.broadcast_to(MOVED, (len(PIXELS), 4, 4)), MODEL)
    assert np.abs(truth - np.eye(2)).max() > 0.1  # the wall is seen distorted
    np.testing.assert_allclose(warps, truth, atol=0.01)


def test_the_identity_replaces_an_impossible_warp() -> None:
    onto_the_wall = np.broadcast_to(se3.exp([*(-1.4 * NORMAL), 0, 0, 0]), (4, 4, 4))
    warps = affine_warps(wall_views(PIXELS), wall_slopes(), onto_the_wall, MODEL)
    beyond = affine_warps(np.full((1, 3), np.nan), np.zeros((1, 2)), MOVED[None], MODEL)
    assert np.isfinite(warps).all() and np.abs(warps).max() <= 2
    np.testing.assert_array_equal(beyond[0], np.eye(2))


def test_slopes_of_a_plane_beside_a_step_and_with_gaps() -> None:
    column, row = np.meshgrid(np.arange(200.0), np.arange(100.0))
    plane = (20 + 0.05 * (column - 100) - 0.02 * (row - 50)).astype(np.float32)
    plane[:, 104:] += 9  # a nearer object beside it
    plane[::3] = np.nan
    slopes = disparity_slopes(plane, np.array([[98.0, 50.0], [5.0, 50.0]]), np.array([19.9, 15.25]))
    np.testing.assert_allclose(slopes[0], [0.05, -0.02], atol=0.004)
    np.testing.assert_allclose(disparity_slopes(plane * np.nan, np.array([[98.0, 50.0]]), np.array([20.0])), [[0, 0]])


def warped(image: PaddedPanorama, warp: Array, center: Array) -> PaddedPanorama:
    """The image as seen after a warp about a point: resampled by the inverse."""
    inverse = np.linalg.inv(warp)
    offset = center - inverse @ center
    columns, rows = np.meshgrid(np.arange(image.width, dtype=float), np.arange(image.image.shape[0], dtype=float))
    x = inverse[0, 0] * columns + inverse[0, 1] * rows + offset[0] + image.pad_px
    y = inverse[1, 0] * columns + inverse[1, 1] * rows + offset[1]
    return wrapped(cv2.remap(image.image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR))


def test_a_warped_patch_is_located_to_hundredths_where_a_rigid_one_errs() -> None:
    warp, center = np.array([[1.15, 0.08], [0.0, 0.92]]), np.array([240.0, 60.0])
    before = wrapped(texture(3))
    after = warped(before, warp, center)
    pixels = center + np.array([[-20.0, -10], [0, 0], [14, 9], [-8, 16], [22, -12], [6, -20]])
    truth = center + (pixels - center) @ warp.T
    predicted = truth + np.array([0.6, -0.4])
    errors = {}
    for name, applied in (("warped", warp), ("rigid", np.eye(2))):
        templates = warped_templates(before, pixels, np.broadcast_to(applied, (6, 2, 2)), predicted)
        assert templates.shape == (6, TEMPLATE_PX, TEMPLATE_PX)
        aligned = align(templates, after, predicted, np.zeros(6, np.intp))
        assert aligned.found.all()
        errors[name] = np.abs(aligned.pixels - truth).max()
    assert errors["warped"] < 0.06 and errors["rigid"] > 3 * errors["warped"]


def test_patches_far_from_where_they_were_predicted_are_refused() -> None:
    image = wrapped(texture(3))
    pixels = np.array([[100.0, 50.0], [200.0, 60.0]])
    templates = warped_templates(image, pixels, np.broadcast_to(np.eye(2), (2, 2, 2)), pixels + 5.0)
    assert not align(templates, image, pixels + 5.0, np.zeros(2, np.intp)).found.any()


def test_rows_in_the_upper_panorama_are_found_where_its_exposure_differs() -> None:
    lower = texture(5)
    upper = np.clip(np.roll(lower, 7, axis=0) * 0.6 + 20, 0, 255).astype(np.uint8)
    points = np.array([[60.0, 40.0], [200.0, 60.0], [330.0, 52.0], [410.0, 70.0]])
    guess = points + np.array([[0, 7.6], [0, 6.5], [0, 7.3], [0, np.nan]])
    rows, variance = align_rows((wrapped(lower), wrapped(upper)), points, guess)
    np.testing.assert_allclose(rows[:3], points[:3, 1] + 7, atol=0.02)
    assert np.isnan(rows[3]) and (variance[:3] > 0).all()
    aside = wrapped(np.roll(upper, 1, axis=1))
    assert np.isnan(align_rows((wrapped(lower), aside), points, guess)[0]).all()


def test_the_noise_of_the_upper_row_is_that_of_the_lower_row_and_of_the_disparity() -> None:
    of_pixels = np.array([[[0.04, 0.01], [0.01, 0.09]]])
    noise = view_noise(of_pixels, np.array([0.25]))
    np.testing.assert_allclose(noise[0], [[0.04, 0.01, 0.01], [0.01, 0.09, 0.09], [0.01, 0.09, 0.34]])
