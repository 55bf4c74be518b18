"""Ocam cameras of real mirrors: wavefronts against the rays of a traced mirror, central and near projection, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.models.wavefront import directions_to, offsets, points_at
from calib.rig import Rig
from calib.rig_file import parse_rig, rig_toml
from tests.simulation.mirrors import MirrorCamera

WAVEFRONT = (2e-4, -1e-4, -3e-4, 4e-4, 5e-5)
MIRROR = MirrorCamera(207.0, (383.5, 383.5), (768, 768), tilt_rad=(0.009, -0.008), conic=0.015, ellipticity=-0.012)


def directions(count: int = 400) -> Array:
    rng = np.random.default_rng(0)
    azimuth, angle = rng.uniform(-np.pi, np.pi, count), np.deg2rad(rng.uniform(5, 120, count))
    return np.column_stack([np.cos(azimuth) * np.sin(angle), np.sin(azimuth) * np.sin(angle), np.cos(angle)])


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


@pytest.mark.parametrize("axis", [1.0, -1.0])
def test_offsets_are_the_gradient_of_the_support_function(axis: float) -> None:
    rays = directions() * (1, 1, axis)

    def support(d: Array) -> Array:
        a, b, c_x, c_y, s = WAVEFRONT
        m = d[:, :2] / (np.linalg.norm(d, axis=1, keepdims=True) + axis * d[:, 2:])
        m2 = (m**2).sum(axis=1)
        return np.asarray(
            (a * (m[:, 0] ** 2 - m[:, 1] ** 2) + b * m[:, 0] * m[:, 1] + m2 * (m @ [c_x, c_y]) + s * m2**2) / (1 + m2)
        )

    step = 1e-5
    gradient = np.column_stack([(support(rays + step * e) - support(rays - step * e)) / (2 * step) for e in np.eye(3)])
    np.testing.assert_allclose(offsets(rays, WAVEFRONT, axis), gradient, atol=1e-11)


def test_rays_pass_their_points() -> None:
    points = 0.3 * directions()
    found = directions_to(points, WAVEFRONT, 1.0)
    np.testing.assert_allclose(np.cross(points - offsets(found, WAVEFRONT, 1.0), found), 0, atol=1e-10)
    np.testing.assert_allclose(points_at(0.3, found, WAVEFRONT, 1.0), directions(), atol=1e-9)


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


def test_terms_are_restored_from_a_file(ocam_rig: Rig) -> None:
    camera = replace(with_terms(ocam_rig), distance_m=2.5)
    text = rig_toml(replace(ocam_rig, lower=replace(ocam_rig.lower, camera=camera)))
    assert parse_rig(text).lower.camera == camera and rig_toml(parse_rig(text)) == text
    for old, new, message in (
        ("distance_m = 2.5", "distance_m = 0.0", "expected distance_m of 0.05"),
        ("wavefront = [0.0002", "wavefront = [2.0", "a wavefront of 5 lengths below 0.1"),
        ("wavefront = [0.0002, ", "wavefront = [", "wavefront: expected a list of 5 numbers"),
    ):
        assert old in text
        with pytest.raises(CalibError, match=message):
            parse_rig(text.replace(old, new, 1))
