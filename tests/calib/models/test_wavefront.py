"""Ocam cameras of real mirrors: wavefronts against the rays of a traced mirror, central and near projection, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.models.ocam import OcamCamera
from calib.models.wavefront import offsets
from calib.rig import Rig
from tests.simulation.mirrors import MirrorCamera

WAVEFRONT = (2e-4, -1e-4, -3e-4, 4e-4, 5e-5)
MIRROR = MirrorCamera(207.0, (383.5, 383.5), (768, 768), tilt_rad=(0.009, -0.008), conic=0.015, ellipticity=-0.012)


def with_terms(rig: Rig, view: str = "mirror") -> OcamCamera:
    camera = rig.lower.camera
    assert isinstance(camera, OcamCamera)
    return replace(camera, view=view, tangential=(1e-6, -2e-6), astigmatism=(3e-10, -2e-10), wavefront=WAVEFRONT)


def test_describes_the_rays_of_a_tilted_camera_under_a_mirror_off_shape() -> None:
    """Offsets of up to a millimetre are fitted to a hundredth of it by the five terms and a shift of the viewpoint."""
    pixels = np.random.default_rng(0).uniform(0, 767, (2000, 2))
    radius = np.hypot(*(pixels - 383.5).T)
    origins, rays = MIRROR.rays(pixels[(radius > 60) & (radius < 370)])
    across = origins - rays * (origins * rays).sum(axis=1, keepdims=True)
    shifts = [axis - rays * rays[:, [k]] for k, axis in enumerate(np.eye(3))]
    terms = [offsets(rays, tuple(unit), 1.0) for unit in np.eye(5)]
    A = np.stack([*shifts, *terms], axis=-1).reshape(-1, 8)
    left = across.ravel() - A @ np.linalg.lstsq(A, across.ravel(), rcond=None)[0]
    central = across.ravel() - A[:, :3] @ np.linalg.lstsq(A[:, :3], across.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(central**2)) > 2e-4 and np.sqrt(np.mean(left**2)) < 5e-6


@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_project_inverts_lift_and_is_exact_at_its_distance(ocam_rig: Rig, view: str) -> None:
    camera = with_terms(ocam_rig, view)
    u, v = camera.center
    azimuth, radius = np.meshgrid(np.linspace(0, 6, 25), np.linspace(5, 330, 20))
    pixels = np.column_stack([u + (radius * np.cos(azimuth)).ravel(), v + (radius * np.sin(azimuth)).ravel()])
    rays = camera.lift(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-6)
    np.testing.assert_allclose(camera.project_near(camera.distance_m * rays), pixels, atol=1e-6)
    moved = np.linalg.norm(camera.project_near(0.4 * rays) - pixels, axis=1)
    assert 0.05 < moved.max() < 1.0
    plain = replace(camera, wavefront=(0.0,) * 5)
    np.testing.assert_array_equal(plain.project_near(rays), plain.project(rays))
