"""Ray-traced mirror cameras: the paraboloid equals the unified model; other cameras are not central."""

from __future__ import annotations

import numpy as np

from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from tests.simulation.images import render
from tests.simulation.mirrors import MirrorCamera

CENTER, SIZE = (384.2, 381.1), (768, 768)
NOMINAL = MirrorCamera(207.0, CENTER, SIZE)
TILTED = MirrorCamera(207.0, CENTER, SIZE, tilt_rad=(0.008, -0.006), conic=0.01, ellipticity=0.01)
PIXELS = np.random.default_rng(0).uniform(60, 700, (300, 2))


def test_paraboloid_below_an_orthographic_camera_equals_the_unified_model() -> None:
    origins, rays = NOMINAL.rays(PIXELS)
    np.testing.assert_allclose(rays, UnifiedCamera(1.0, (-207.0, 207.0), CENTER, SIZE).lift(PIXELS), atol=1e-12)
    np.testing.assert_allclose(np.cross(origins, rays), 0, atol=1e-12)


def test_project_inverts_the_rays_at_any_distance() -> None:
    origins, rays = TILTED.rays(PIXELS)
    distance = np.random.default_rng(1).uniform(0.2, 5, (len(PIXELS), 1))
    np.testing.assert_allclose(TILTED.project(origins + distance * rays), PIXELS, atol=1e-7)


def test_a_rendered_spot_near_a_tilted_camera_equals_the_projection() -> None:
    """At 0.25 m the ray's origin on the mirror moves the image by about a pixel."""
    camera = MirrorCamera(52.0, (95.5, 95.5), (192, 192), tilt_rad=(0.05, -0.03), conic=0.05)
    middle = np.array([0.2, 0.1, 0.1])
    edge_u, edge_v = np.array([0.012, -0.024, 0.0]), np.array([0.01, 0.005, -0.025])
    spot = Rectangle(middle - (edge_u + edge_v) / 2, edge_u, edge_v, np.full((8, 8), 255, np.uint8))
    mounted = MountedCamera(camera, np.eye(4), Mask(camera.center, 0.0, 92.0))
    image = render(Scene((spot,)), mounted, np.eye(4), 4).astype(float)
    rows, columns = np.indices(image.shape)
    centroid = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    grid = spot.points(np.stack(np.meshgrid(*2 * [np.linspace(0.05, 0.95, 10)]), axis=-1).reshape(-1, 2))
    np.testing.assert_allclose(centroid, camera.project(grid).mean(axis=0), atol=0.1)
