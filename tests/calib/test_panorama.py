"""Panoramas of cameras that share a part of the circle: pinholes and fisheyes one above the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.panorama import Cylinder, fit_cylinder, remap_tables, visible
from calib.rig import MountedCamera, Rig
from tests.limited import run_limited
from tests.simulation.rigs import R_RIG_AHEAD, lens, lens_rig

# Widest step at which a sector begins or ends, and what misaligned cameras and the corners of an image add or take.
STEP_DEG, CORNERS_DEG = 3.75, 3.0


@pytest.mark.parametrize(
    ("model", "field_deg", "size"),
    [
        ("pinhole", 30, (320, 240)),
        ("pinhole", 90, (640, 360)),
        ("equidistant", 60, (320, 240)),
        ("equidistant", 150, (640, 120)),
        ("ds", 120, (640, 240)),
        ("equidistant", 240, (960, 110)),
        ("equidistant", 280, (1200, 110)),
    ],
)
@pytest.mark.parametrize("heading_deg", [20.0, -173.0])
def test_a_sector_has_the_columns_of_what_both_cameras_see(
    model: str, field_deg: float, size: tuple[int, int], heading_deg: float
) -> None:
    """Its middle is where the cameras look, also across the seam behind, and its resolution is that of the images."""
    camera = lens(model, field_deg, size)
    rig = lens_rig(camera, heading_deg=heading_deg)
    cylinder = fit_cylinder(rig)
    span_deg = 360 * cylinder.width / cylinder.turn_px
    assert field_deg - CORNERS_DEG < span_deg < field_deg + 2 * STEP_DEG + 8 * CORNERS_DEG
    middle = np.rad2deg(sum(cylinder.edges_rad) / 2) - heading_deg
    assert abs(math.remainder(middle, 360)) < STEP_DEG + CORNERS_DEG
    per_rad = np.linalg.norm(np.diff(camera.project(np.array([[-0.01, 0, 1], [0.01, 0, 1.0]])), axis=0)) / 0.02
    assert 0.7 * per_rad < cylinder.focal_px < 1.9 * per_rad
    # No column of what both see is missing.
    wide = Cylinder(cylinder.turn_px, cylinder.height, cylinder.row0)
    both = np.logical_and(*(visible(m, remap_tables(rig, m, wide)) for m in (rig.lower, rig.upper)))
    missing = both.any(axis=0)
    missing[(cylinder.first + np.arange(cylinder.width)) % cylinder.turn_px] = False
    assert missing.mean() < 0.002


def test_pixels_and_rays_of_a_sector_agree_with_those_of_the_full_turn() -> None:
    """Each point has one column; what the sector does not show lies beside it, never in it."""
    rng = np.random.default_rng(1)
    for first in (0, 300, 1100):
        cylinder = Cylinder(300, 200, 90.0, 1200, first)
        points = rng.normal(0, 2, (500, 3))
        pixels, of_turn = cylinder.pixels(points), cylinder.full_turn.pixels(points)
        np.testing.assert_allclose(cylinder.full_turn.wrap(pixels[:, 0] + first - of_turn[:, 0]), 0, atol=1e-9)
        assert (np.abs(pixels[:, 0] - 150) <= 600 + 1e-9).all()
        np.testing.assert_array_equal(cylinder.shows(pixels[:, 0]), (of_turn[:, 0] - first) % 1200 <= 299)
        rays = cylinder.rays(pixels)
        np.testing.assert_allclose(np.cross(rays, points), 0, atol=1e-9 * 100)
        assert ((rays * points).sum(axis=1) > 0).all()


def test_cameras_that_share_no_view_are_refused() -> None:
    """Two lenses back to back share nothing; one line says so."""
    rig = lens_rig(lens("pinhole", 90))
    turned = rig.upper.T_cam_rig @ se3.transform(se3.rotation_exp([0, 0, math.pi]), np.zeros(3))
    with pytest.raises(CalibError, match="share no view"):
        fit_cylinder(replace(rig, upper=replace(rig.upper, T_cam_rig=turned)))


@pytest.mark.parametrize(("field_deg", "is_enough"), [(190, False), (195, False), (230, True)])
def test_lenses_back_to_back_side_by_side_need_a_shared_ring(field_deg: float, is_enough: bool) -> None:
    """Lenses of 190 degrees share 10 of them about their common axis, those of 195 a bit less than 15, of 230 50."""
    camera = lens("equidistant", field_deg, (640, 640))
    poses = [
        se3.transform(se3.rotation_exp([0.0, 0.0, turn]) @ R_RIG_AHEAD, np.array([x, 0.0, 0.0]))
        for turn, x in ((0.0, 0.015), (math.pi, -0.015))
    ]
    rig = Rig(*(MountedCamera(camera, se3.inverse(T), Mask(camera.center, 0.0, 319.0)) for T in poses))
    if is_enough:
        assert fit_cylinder(rig).width > 500
    else:
        shared = field_deg - 180
        with pytest.raises(CalibError, match=rf"share {shared - 1}\.\d degrees of elevation.*back to back"):
            fit_cylinder(rig)


def enlarged(rig: Rig, factor: float) -> Rig:
    """Return the rig with images that are larger and have the same field of view."""
    mounted = []
    for side in (rig.lower, rig.upper):
        camera = side.camera
        assert isinstance(camera, UnifiedCamera)
        width, height = (round(side_px * factor) for side_px in camera.size)
        focal, center = (tuple(factor * value for value in values) for values in (camera.focal, camera.center))
        larger = UnifiedCamera(
            camera.xi, (focal[0], focal[1]), (center[0], center[1]), (width, height), camera.distortion
        )
        mounted.append(MountedCamera(larger, side.T_cam_rig))
    return Rig(mounted[0], mounted[1])


@pytest.mark.parametrize(("factor", "reason"), [(11, "16384 columns"), (1e30, "columns")])
def test_refuses_a_rig_that_asks_for_a_huge_panorama(omni_rig: Rig, factor: float, reason: str) -> None:
    with pytest.raises(CalibError, match=reason) as caught:
        fit_cylinder(enlarged(omni_rig, factor))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


TABLES = """
from tests.calib.conftest import misaligned, omni_cameras
from calib.panorama import Cylinder, remap_tables
rig = misaligned(*omni_cameras())
u, v = remap_tables(rig, rig.lower, Cylinder(4096, 1500, 700.0))
print(u.shape)
"""


def test_tables_take_little_more_memory_than_they_need(omni_rig: Rig) -> None:
    """6 million pixels: 49 MB of tables; all at once the projection would take more than 1 GB."""
    printed, memory_mb = run_limited(TABLES)
    assert printed == "(1500, 4096)" and memory_mb < 250
