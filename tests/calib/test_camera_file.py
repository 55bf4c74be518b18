"""camera.toml: round trips, masks, errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.camera_file import CameraFile, Quality, camera_toml, parse_camera, read_camera
from calib.errors import CalibError
from calib.models.camera import Mask, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

OMNI = UnifiedCamera(1.1, (-214.0, 206.0), (390.0, 379.0), (780, 768), (-0.01, 0.002, 1e-4, -2e-4))
OCAM = OcamCamera((-131.64, 0.0, 1.88e-3, 9.4e-8, -6.1e-10), (382.4, 514.6), (0.99923, 2.2e-4, 2.2e-4), (1024, 768))
QUALITY = Quality(0.25, 10, [("a0", -131.64, 0.2), ("d = e", 2.2e-4, 1e-5)])


TANGENTIAL = replace(OCAM, tangential=(2e-6, -3e-6))


def test_tangential_terms_are_written_only_if_there_are_any() -> None:
    assert "p1" not in camera_toml(CameraFile(OCAM)) and "p2 = -3e-06" in camera_toml(CameraFile(TANGENTIAL))


@pytest.mark.parametrize("camera", [OMNI, OCAM, TANGENTIAL, replace(OCAM, view="direct")])
def test_camera_round_trip(camera: OmniCamera, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(camera_toml(CameraFile(camera), QUALITY))
    assert read_camera(path) == CameraFile(camera)


def test_mask_round_trip_as_file_and_embedded(tmp_path: Path) -> None:
    image = np.zeros((768, 1024), np.uint8)
    image[100:600, 200:800] = 255
    for name in ("", "edited.png"):
        text = camera_toml(CameraFile(OCAM, Mask((514.0, 382.0), 60.0, 370.0, image)), mask_image=name)
        if name:
            with pytest.raises(CalibError, match=r"edited\.png"):
                parse_camera(text, tmp_path)
            cv2.imwrite(str(tmp_path / name), 255 - image)
        mask = parse_camera(text, tmp_path).mask
        assert mask is not None and mask.image is not None and (mask.inner_px, mask.outer_px) == (60.0, 370.0)
        np.testing.assert_array_equal(mask.image, 255 - image if name else image)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema: expected version 1"),
        ('model = "ocam"', 'model = "lens"', "camera.model: expected omni or ocam"),
        ("[camera]", "[lower]", "unknown key|expected a table"),
        ("c = 0.99923", "cc = 0.99923", "camera.intrinsics.cc: unknown key"),
        ("schema = 1", "schema = ", "not a TOML file"),
    ],
)
def test_errors_name_the_key(old: str, new: str, message: str) -> None:
    text = camera_toml(CameraFile(OCAM), QUALITY)
    assert old in text
    with pytest.raises(CalibError, match=message):
        parse_camera(text.replace(old, new))
