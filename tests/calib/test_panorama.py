"""Panoramas of cameras that share a part of the circle, one above the other, and the rims of mirrors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Mask
from calib.panorama import Cylinder, fit_cylinder, remap_tables, visible
from calib.rig import MountedCamera, Rig
from calib.rim import find_rim
from tests.simulation.rigs import R_RIG_AHEAD, lens, lens_rig

# Widest step at which a sector begins or ends, and what misaligned cameras and the corners of an image add or take.
STEP_DEG, CORNERS_DEG = 3.75, 3.0


@pytest.mark.parametrize(
    ("model", "field_deg", "size"),
    [
        ("pinhole", 90, (640, 360)),
        ("equidistant", 150, (640, 120)),
        ("ds", 120, (640, 240)),
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
    span_deg = 360 * cylinder.width / cylinder.period_px
    assert field_deg - CORNERS_DEG < span_deg < field_deg + 2 * STEP_DEG + 8 * CORNERS_DEG
    middle = np.rad2deg(cylinder.azimuth(np.array([(cylinder.width - 1) / 2]))[0]) - heading_deg
    assert abs(math.remainder(middle, 360)) < STEP_DEG + CORNERS_DEG
    per_rad = np.linalg.norm(np.diff(camera.project(np.array([[-0.01, 0, 1], [0.01, 0, 1.0]])), axis=0)) / 0.02
    assert 0.7 * per_rad < cylinder.focal_px < 1.9 * per_rad
    # No column of what both see is missing.
    wide = Cylinder(cylinder.period_px, cylinder.height, cylinder.row0)
    both = np.logical_and(*(visible(m, remap_tables(rig, m, wide)) for m in (rig.lower, rig.upper)))
    missing = both.any(axis=0)
    missing[(cylinder.first + np.arange(cylinder.width)) % cylinder.period_px] = False
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
def test_lenses_back_to_back_side_by_side_need_shared_elevations(field_deg: float, is_enough: bool) -> None:
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


# Rims of mirrors, drawn and real


Image = NDArray[np.uint8]
CENTER, RADIUS = (391.3, 377.6), 340.7
V, U = np.mgrid[:768, :768].astype(float)
R = np.hypot(U - CENTER[0], V - CENTER[1])


def world(seed: int = 0) -> NDArray[np.float64]:
    """Return an image with light and dark patches."""
    coarse = np.random.default_rng(seed).uniform(40, 230, (24, 24))
    return np.asarray(cv2.resize(coarse, (768, 768), interpolation=cv2.INTER_LINEAR))


def drawn(inner: float = 0.0, outer: float = RADIUS, blur: float = 0.8, noise: float = 2.0) -> Image:
    fine = np.where((outer > R) & (inner <= R), world(), 9.0)
    soft = cv2.GaussianBlur(fine, (0, 0), blur) + np.random.default_rng(1).normal(0, noise, fine.shape)
    return np.clip(soft, 0, 255).astype(np.uint8)


def assert_ring(mask: Mask | None, inner: float = 0.0, outer: float = RADIUS) -> None:
    assert mask is not None
    assert mask.center == pytest.approx(CENTER, abs=0.25)
    assert mask.outer_px == pytest.approx(outer - 1.5, abs=0.6)
    assert mask.inner_px == pytest.approx(inner + 1.5 if inner else 0.0, abs=3.0 if inner else 0.0)


@pytest.mark.parametrize("guess", [CENTER, (384.0, 384.0), (410.0, 350.0)])
def test_a_drawn_rim_is_found_from_different_guesses(guess: tuple[float, float]) -> None:
    assert_ring(find_rim(drawn(), guess))


NOTHING: dict[str, Callable[[], NDArray[np.float64]]] = {
    "black": lambda: 0 * U,
    "noise": lambda: np.random.default_rng(0).uniform(0, 255, U.shape),
    "soft vignette": lambda: 220 * np.exp(-((R / 300) ** 2)),
    "ellipse": lambda: np.where(np.hypot((U - 384) / 1.15, V - 384) < 300, 150, 5),
    "most of the rim dark": lambda: np.where((R < RADIUS) & (V < 500) & (U > 300), world(), 5),
    "blobs": lambda: cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, U.shape), (0, 0), 25) * 30 - 3700,
}


@pytest.mark.parametrize("name", NOTHING)
def test_images_without_a_rim_give_none(name: str) -> None:
    image = np.clip(NOTHING[name](), 0, 255).astype(np.uint8)
    assert find_rim(image, (image.shape[1] / 2, image.shape[0] / 2)) is None


def test_the_rim_of_a_real_mirror_is_found(shared_data: Path) -> None:
    """Ten images of one mirror: the image cuts off its rim above and below, and the lens is in its middle."""
    images: list[Any] = [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((shared_data / "vmr_board").glob("*.jpg"))
    ]
    found = [find_rim(image, (512.0, 384.0)) for image in images]
    masks = [mask for mask in found if mask is not None]
    assert len(masks) >= 8
    rings = np.array([(*mask.center, mask.inner_px, mask.outer_px) for mask in masks])
    assert (np.ptp(rings, axis=0) < (1.0, 1.0, 3.0, 0.6)).all()
    np.testing.assert_allclose(rings.mean(axis=0), (516.7, 384.1, 79.0, 451.7), atol=1.0)
