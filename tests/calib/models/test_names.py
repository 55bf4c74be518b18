"""Names of the camera models, and what of them sees without a mirror."""

from __future__ import annotations

import pytest

from calib.models.camera import OmniCamera, inscribed_mask, whole_image
from calib.models.equirectangular import EquirectangularCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.names import model_in_words, model_name, sees_directly, visible_part
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

FOCAL, CENTER, SIZE = (200.0, 200.0), (320.0, 240.0), (640, 480)
MIRROR = OcamCamera((-100.0, 0.0, 1e-3), (240.0, 320.0), (1.0, 0.0, 0.0), SIZE)
DIRECT = OcamCamera((-100.0, 0.0, 1e-3), (240.0, 320.0), (1.0, 0.0, 0.0), SIZE, "direct")


@pytest.mark.parametrize(
    ("camera", "name", "is_direct"),
    [
        (MIRROR, "ocam", False),
        (DIRECT, "ocam", True),
        (UnifiedCamera(1.0, (-200.0, 200.0), CENTER, SIZE), "omni", False),
        (UnifiedCamera(1.0, FOCAL, CENTER, SIZE), "omni", True),
        (UnifiedCamera(0.0, (-200.0, 200.0), CENTER, SIZE), "omni", True),
        (DoubleSphereCamera(0.0, 0.5, FOCAL, CENTER, SIZE), "ds", True),
        (ExtendedUnifiedCamera(0.5, 1.0, FOCAL, CENTER, SIZE), "eucm", True),
        (EquidistantCamera((0.0, 0.0, 0.0, 0.0), FOCAL, CENTER, SIZE), "equidistant", True),
        (EquirectangularCamera(FOCAL, CENTER, SIZE), "equirectangular", True),
    ],
)
def test_models_have_names_and_mirrors_a_disc(camera: OmniCamera, name: str, is_direct: bool) -> None:
    assert model_name(camera) == name and sees_directly(camera) == is_direct
    assert visible_part(camera) == (whole_image(camera) if is_direct else inscribed_mask(camera))


def test_the_view_of_a_polynomial_is_part_of_its_name() -> None:
    assert (model_in_words(MIRROR), model_in_words(DIRECT)) == ("ocam, mirror view", "ocam, direct view")
    assert model_in_words(UnifiedCamera(0.0, FOCAL, CENTER, SIZE)) == "omni"
