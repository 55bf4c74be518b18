"""Models of fisheye lenses that Kalibr calibrates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from tests.calib.models.test_camera import CAMERAS


def test_lens_projections_equal_the_equations() -> None:
    """One point (3, -4, 2): distance sqrt(29), distance from the axis 5."""
    point, size = np.array([[3.0, -4.0, 2.0]]), (2000, 2000)
    d1 = math.sqrt(29)
    shifted = -0.2 * d1 + 2
    under = 0.6 * math.sqrt(25 + shifted**2) + 0.4 * shifted
    (pixel,) = DoubleSphereCamera(-0.2, 0.6, (300.0, 310.0), (900.0, 950.0), size).project(point)
    np.testing.assert_allclose(pixel, [900 + 300 * 3 / under, 950 - 310 * 4 / under], rtol=0, atol=1e-9)
    under = 0.6 * math.sqrt(1.2 * 25 + 4) + 0.4 * 2
    (pixel,) = ExtendedUnifiedCamera(0.6, 1.2, (300.0, 310.0), (900.0, 950.0), size).project(point)
    np.testing.assert_allclose(pixel, [900 + 300 * 3 / under, 950 - 310 * 4 / under], rtol=0, atol=1e-9)
    t = math.atan2(5, 2)
    radius = t + 0.01 * t**3 - 0.02 * t**5 + 0.003 * t**7 - 0.0004 * t**9
    (pixel,) = EquidistantCamera((0.01, -0.02, 0.003, -0.0004), (300.0, 310.0), (900.0, 950.0), size).project(point)
    np.testing.assert_allclose(pixel, [900 + 300 * radius * 0.6, 950 - 310 * radius * 0.8], rtol=0, atol=1e-9)


def test_lenses_see_behind_them_as_far_as_their_model_goes() -> None:
    sideways = np.array([[1.0, 0.0, -0.2], [1.0, 0.0, -5.0]])
    for name in ("ds", "eucm", "equidistant"):
        pixels = CAMERAS[name].project(sideways)
        assert np.isfinite(pixels[0]).all(), name
    assert np.isnan(CAMERAS["ds"].project(sideways)[1]).all()
    folding = EquidistantCamera((-0.2, 0.0, 0.0, 0.0), (225.0, 225.0), (380.0, 390.0), (768, 770))
    assert folding.widest_rad == pytest.approx(math.sqrt(1 / 0.6), abs=0.01)
    assert np.isnan(folding.project(np.array([[1.0, 0.0, -1.0]]))).all()
