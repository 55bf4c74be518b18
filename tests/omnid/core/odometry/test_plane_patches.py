"""Patches of a slanted wall, seen from elsewhere, are where they belong: without the bias of an affine map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.patch_alignment import affine_warps, align, warped_templates
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.core.rig.plane_patches import plane_templates
from omnid.core.stereo.triangulation import view

Array = NDArray[np.float64]

CYLINDER, PAD_PX = Cylinder(1200, 300, 150.0), 48
MODEL = StereoModel(CYLINDER, 0.2, 0.1)
NORMAL, DISTANCE_M = np.array([1.0, 0.0, 0.0]), 1.4  # a wall ahead, seen aslant to the left
T_CURR_REF = se3.inverse(se3.transform(se3.rotation_exp([0.0, 0.0, 0.4]), np.array([0.5, 0.2, 0.0])))


def texture(points: Array) -> Array:
    """Return the grey levels of points (..., 3) on the wall: waves of 6 to 25 cm."""
    y, z = points[..., 1], points[..., 2]
    rng = np.random.default_rng(3)
    waves = [np.sin(2 * np.pi * (y * np.cos(a) + z * np.sin(a)) / length + phase)
             for length, a, phase in zip(np.geomspace(0.06, 0.25, 24), rng.uniform(0, np.pi, 24),
                                         rng.uniform(0, 6, 24), strict=True)]
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


def views_at(pixels: Array) -> Array:
    """Return the views (N, 3) of the wall at pixels (N, 2) of the keyframe."""
    return view(on_wall(np.eye(4), CYLINDER.rays(pixels)), CYLINDER, MODEL.baseline_m)


@pytest.mark.parametrize("upper", [False, True])
def test_patches_of_a_wall_seen_aslant_are_not_shifted(upper: bool) -> None:
    rng = np.random.default_rng(1)
    pixels = np.column_stack([rng.uniform(420, 560, 150), rng.uniform(90, 200, 150)])
    views = views_at(pixels)
    slopes = np.stack([(np.subtract(*(views_at(pixels + sign * step) for sign in (1, -1))) @ [0, -1, 1]) / 2
                       for step in np.eye(2)], axis=1)
    points = on_wall(np.eye(4), CYLINDER.rays(pixels))
    seen = view(se3.apply(T_CURR_REF, points), CYLINDER, MODEL.baseline_m)[:, [0, 2] if upper else [0, 1]]
    keyframe = panorama(np.eye(4))
    current = panorama(se3.inverse(T_CURR_REF), MODEL.baseline_m if upper else 0.0)
    T, groups = np.tile(T_CURR_REF, (150, 1, 1)), np.zeros(150, np.intp)
    exact = plane_templates(keyframe, (views, slopes), T, MODEL, seen, upper=upper)
    affine = warped_templates(keyframe, views[:, :2], affine_warps(views, slopes, T, MODEL, upper=upper), seen)
    by_plane, by_affine = (align(templates, current, seen, groups) for templates in (exact, affine))
    good = by_plane.found & by_affine.found
    assert good.sum() > 100
    bias, before = (np.abs(np.median((found.pixels - seen)[good], axis=0)).max() for found in (by_plane, by_affine))
    assert bias < 0.006 < 0.02 < before
