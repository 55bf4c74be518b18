"""Patches of a slanted wall are as another view shows them, and the slopes of the wall are found by the pair."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.plane_patches import align, fitted_slopes, plane_templates
from omnid.core.stereo.triangulation import view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

CYLINDER, PAD_PX = Cylinder(1200, 300, 150.0), 48
MODEL = StereoModel(CYLINDER, 0.2, 0.1)
NORMAL, DISTANCE_M = np.array([1.0, 0.0, 0.0]), 1.4  # a wall ahead, seen aslant to the left
T_CURR_REF = se3.inverse(se3.transform(se3.rotation_exp([0.0, 0.0, 0.4]), np.array([0.5, 0.2, 0.0])))


def texture(points: Array) -> Array:
    """Return the grey levels of points (..., 3) on the wall: waves of 6 to 25 cm."""
    y, z = points[..., 1], points[..., 2]
    rng = np.random.default_rng(3)
    waves = [
        np.sin(2 * np.pi * (y * np.cos(a) + z * np.sin(a)) / length + phase)
        for length, a, phase in zip(
            np.geomspace(0.06, 0.25, 24), rng.uniform(0, np.pi, 24), rng.uniform(0, 6, 24), strict=True
        )
    ]
    return 128 + 18 * np.sum(waves, axis=0)


def on_wall(T_ref_view: Array, rays: Array, height_m: float = 0.0) -> Array:
    """Return the points (..., 3) of the wall, in the keyframe's frame, on rays of a view."""
    origin, turned = se3.apply(T_ref_view, np.array([0.0, 0.0, height_m])), rays @ T_ref_view[:3, :3].T
    reach = (DISTANCE_M - origin @ NORMAL) / (turned @ NORMAL)
    return np.where((reach > 0)[..., None], origin + reach[..., None] * turned, np.nan)


def panorama(T_ref_view: Array, height_m: float = 0.0) -> PaddedPanorama:
    columns, rows = np.meshgrid(np.arange(-PAD_PX, CYLINDER.width + PAD_PX), np.arange(CYLINDER.height))
    rays = CYLINDER.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    grey = np.nan_to_num(texture(on_wall(T_ref_view, rays, height_m)), nan=128.0)
    return PaddedPanorama(np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(columns.shape), PAD_PX)


def surfaces_at(pixels: Array, T_ref_view: Array | None = None) -> tuple[Array, Array]:
    """Return the points (N, 3) of the wall at pixels (N, 2), in the frame of a view, and slopes of the disparity."""
    T = np.eye(4) if T_ref_view is None else T_ref_view

    def seen(pixels: Array) -> Array:
        return se3.apply(se3.inverse(T), on_wall(T, CYLINDER.rays(pixels)))

    def disparity(pixels: Array) -> Array:
        views = view(seen(pixels), CYLINDER, MODEL.baseline_m)
        return np.asarray(views[:, 2] - views[:, 1])

    slopes = [(disparity(pixels + step) - disparity(pixels - step)) / 2 for step in np.eye(2)]
    return seen(pixels), np.column_stack(slopes)


def pixels_of(count: int) -> Array:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(420, 560, count), rng.uniform(90, 200, count)])


def seen_at(points: Array, upper: bool) -> Array:
    """Return the pixels (N, 2) of points of the keyframe in the current view's lower or upper panorama."""
    return view(se3.apply(T_CURR_REF, points), CYLINDER, MODEL.baseline_m)[:, [0, 2] if upper else [0, 1]]


def templates_of(surfaces: tuple[Array, Array], pixels: Array, seen: Array, *, upper: bool) -> NDArray[np.float32]:
    return 128 + plane_templates(panorama(np.eye(4)), pixels, surfaces, T_CURR_REF, seen, MODEL, upper=upper)


@pytest.mark.parametrize("upper", [False, True])
def test_patches_of_a_wall_are_the_pixels_of_the_other_view(upper: bool) -> None:
    pixels = pixels_of(150)
    points, slopes = surfaces_at(pixels)
    seen = seen_at(points, upper)
    current = panorama(se3.inverse(T_CURR_REF), MODEL.baseline_m if upper else 0.0)
    exact = templates_of((points, slopes), pixels, seen, upper=upper)
    half = exact.shape[1] // 2
    shown = [
        current.image[row - half : row + half + 1, PAD_PX + column - half : PAD_PX + column + half + 1]
        for column, row in np.rint(seen).astype(int).tolist()
    ]
    contrast = np.std([patch.astype(float) for patch in shown], axis=(1, 2)).mean()
    assert np.abs(exact.astype(float) - shown).mean() < 0.04 * contrast
    # Upright surfaces in the place of the wall are something else, and shift the patches.
    upright = templates_of((points, 0 * slopes), pixels, seen, upper=upper)
    assert np.abs(upright.astype(float) - shown).mean() > 0.12 * contrast
    found = align(exact, current, seen)
    assert found.found.sum() > 100
    assert np.abs(np.median((found.pixels - seen)[found.found], axis=0)).max() < 0.003


def test_slopes_are_fitted_from_a_wrong_start() -> None:
    pixels = np.rint(pixels_of(60))
    points, slopes = surfaces_at(pixels)
    near = view(points, CYLINDER, MODEL.baseline_m)[:, [0, 2]] + 0.3
    near[0] = np.nan
    pair = panorama(np.eye(4)), panorama(np.eye(4), MODEL.baseline_m)
    start = np.zeros((60, 2))
    fitted = fitted_slopes(pair, pixels, near, start, MODEL)
    assert np.median(np.abs(slopes)[:, 0]) > 0.05
    assert np.median(np.abs(fitted - slopes)[1:], axis=0).max() < 0.004
    np.testing.assert_array_equal(fitted[0], start[0])
