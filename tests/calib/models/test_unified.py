"""The unified model of central mirrors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.models.camera import Mask, OmniCamera, field_of_view
from calib.models.unified import UnifiedCamera
from tests.calib.models.test_camera import CAMERAS


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> OmniCamera:
    return CAMERAS[request.param]


def test_omni_projection_equals_the_equations() -> None:
    camera = UnifiedCamera(0.5, (-200.0, 300.0), (100.0, 50.0), (640, 480), (0.1, 0.2, 0.01, 0.02))
    mx, my = (2 / 3) / (1 / 3 + 0.5), (-2 / 3) / (1 / 3 + 0.5)  # of the unit ray (2, -2, 1) / 3
    r2 = mx * mx + my * my
    radial = 1 + 0.1 * r2 + 0.2 * r2 * r2
    x = mx * radial + 2 * 0.01 * mx * my + 0.02 * (r2 + 2 * mx * mx)
    y = my * radial + 0.01 * (r2 + 2 * my * my) + 2 * 0.02 * mx * my
    (pixel,) = camera.project(np.array([[4.0, -4.0, 2.0]]))
    np.testing.assert_allclose(pixel, [100 - 200 * x, 50 + 300 * y], rtol=0, atol=1e-9)


def test_omni_with_xi_zero_is_a_pinhole() -> None:
    camera = UnifiedCamera(0.0, (100.0, 110.0), (50.0, 60.0), (640, 480))
    np.testing.assert_allclose(camera.project(np.array([[1.0, 2.0, 4.0]])), [[75.0, 115.0]])
    assert np.isnan(camera.project(np.array([[1.0, 2.0, -0.1]]))).all()


def test_field_of_view_of_a_parabolic_mirror() -> None:
    """A ring of radius rho of a parabolic mirror of focal length f lies at 2 atan(rho / f) from the axis."""
    camera = UnifiedCamera(1.0, (-200.0, 200.0), (400.0, 380.0), (800, 760))
    nearest, farthest = field_of_view(camera, Mask((400.0, 380.0), 60.0, 340.0))
    assert nearest == pytest.approx(2 * math.atan(60 / 200), abs=1e-9)
    assert farthest == pytest.approx(2 * math.atan(340 / 200), abs=1e-9)
    assert all(map(math.isnan, field_of_view(camera, Mask((400.0, 380.0), 5000.0, 6000.0))))
