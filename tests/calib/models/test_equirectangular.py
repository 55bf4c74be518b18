"""Equirectangular images, as cameras of 360 degrees stitch them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.models.camera import OmniCamera
from calib.models.equirectangular import EquirectangularCamera
from tests.calib.models.test_camera import CAMERAS


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> OmniCamera:
    return CAMERAS[request.param]


def test_projects_the_axis_to_the_centre_and_invalid_points_to_nan(camera: OmniCamera) -> None:
    axis = camera.lift(np.array([camera.center]))
    assert abs(axis[0, 2]) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(camera.project(3 * axis), [camera.center], rtol=0, atol=1e-6)
    nothing = np.array([[0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], -3 * axis[0]])
    if isinstance(camera, EquirectangularCamera):  # it sees what is behind it
        nothing = nothing[:3]
    with np.errstate(invalid="ignore"):  # numpy's own warnings of infinite points
        assert np.isnan(camera.project(nothing)).any(axis=1).all()
        assert np.isnan(camera.lift(np.array([[np.nan, 3.0], [np.inf, 1.0]]))).any(axis=1).all()
