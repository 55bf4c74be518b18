"""Steps about a camera's parameters: one moves the image by about a pixel, and zeros give the camera back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.fit.parameterisation import parameterise
from calib.models.camera import OmniCamera
from calib.models.lens import EquidistantCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

SIZE = (780, 768)
OMNI = UnifiedCamera(0.93, (-205.0, 206.2), (394.2, 380.9), SIZE, (-0.02, 0.004, 1e-3, -2e-3))
OCAM = OcamCamera(
    (-131.6, 0.0, 1.9e-3, 9e-8, -6e-10), (380.9, 394.2), (0.998, 2e-4, 2e-4), SIZE, tangential=(1e-7, 2e-7)
)


@pytest.mark.parametrize("camera", [OMNI, OCAM])
def test_no_step_is_the_camera_and_one_step_is_about_a_pixel(camera: OmniCamera) -> None:
    parameters, count = parameterise(camera), len(parameterise(camera).names)
    assert parameters.camera_at(np.zeros(count)) == camera
    rays = camera.lift(np.array([[394.0 + 250 * np.cos(a), 381.0 + 250 * np.sin(a)] for a in np.arange(0, 6.2, 0.3)]))
    still = camera.project(rays)
    for number in range(count):
        moved = np.linalg.norm(parameters.camera_at(np.eye(count)[number]).project(rays) - still, axis=1)
        assert 0.05 < moved.max() < 12, parameters.names[number]


def test_terms_of_distortion_are_parameters_where_they_are_not_zero_or_asked_for() -> None:
    plain = replace(OMNI, distortion=(0.0, 0.0, 0.0, 0.0))
    names = ("xi", "fu", "fv", "pu", "pv")
    assert parameterise(plain).names == names
    assert parameterise(plain, ("k1",)).names == (*names, "k1") and len(parameterise(OMNI).names) == 9


def test_the_affine_terms_keep_their_difference() -> None:
    parameters = parameterise(OCAM)
    steps = np.zeros(len(parameters.names))
    steps[parameters.names.index("d")] = 2.0
    moved = parameters.camera_at(steps)
    assert isinstance(moved, OcamCamera) and moved.affine[1] != OCAM.affine[1]
    assert moved.affine[2] - moved.affine[1] == pytest.approx(OCAM.affine[2] - OCAM.affine[1])


def test_a_wavefront_is_a_parameter_on_demand() -> None:
    more = set(parameterise(OCAM, wavefront=True).names) - set(parameterise(OCAM).names)
    assert len(more) == 7


def test_lenses_have_no_parameterisation() -> None:
    lens = EquidistantCamera((0.0, 0.0, 0.0, 0.0), (200.0, 200.0), (320.0, 240.0), (640, 480))
    with pytest.raises(CalibError, match="calibrate lenses by Kalibr"):
        parameterise(lens)
