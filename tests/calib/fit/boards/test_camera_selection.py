"""Selection of the camera model: ray-traced mirrors, cross-validation, misfit of a model that is too simple."""

from __future__ import annotations

import pytest

from calib.errors import CalibError
from calib.fit.boards.camera_selection import MODELS, camera_structure, select_calibration
from calib.models.ocam import OcamCamera
from tests.calib.fit.boards.selected_views import BOARD, MASK, SIZE, views
from tests.simulation.mirrors import MirrorCamera

# A camera tilted by half a degree under a mirror 1 % off the paraboloid.
TILTED = MirrorCamera(207.0, MASK.center, SIZE, tilt_rad=(0.007, -0.005), conic=0.01, ellipticity=0.01)


@pytest.mark.slow
def test_selects_a_model_that_describes_a_tilted_camera() -> None:
    selected = select_calibration(views(TILTED), BOARD, SIZE)
    assert selected.model != "ocam" and [score.model for score in selected.scores] == list(MODELS)
    by_model = {score.model: score for score in selected.scores}
    assert (
        by_model["ocam"].structure.is_misfit and by_model["ocam"].held_out_px > 2 * by_model[selected.model].held_out_px
    )
    assert not camera_structure(selected.calibration).is_misfit
    assert selected.calibration.fit.mean_px < 0.08


@pytest.mark.slow
def test_the_tangential_model_describes_a_tilted_camera() -> None:
    found = select_calibration(views(TILTED), BOARD, SIZE, "ocam_tangential").calibration
    assert isinstance(found.camera, OcamCamera) and any(found.camera.tangential)
    assert found.fit.mean_px < 0.08 and not camera_structure(found).is_misfit
    assert [name for name, _, _ in found.parameters][-2:] == ["p1", "p2"]


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(CalibError, match=r"model: expected one of auto, .*found 'pinhole'"):
        select_calibration([], BOARD, SIZE, "pinhole")  # type: ignore[arg-type]
