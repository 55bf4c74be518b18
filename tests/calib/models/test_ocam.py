"""OCamCalib's results by its file's conventions: its poses and corners give its reprojection errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.importers import parse_ocam
from calib.models.camera import Array
from calib.models.ocam import View

KEYS = ("ocam_std", "ocam_subpix")


def reference(shared_data: Path, key: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((shared_data / "vmr_board" / "reference.json").read_text())[key]
    return found


def text(numbers: dict[str, Any]) -> str:
    """Return the toolbox's calib_results.txt of these numbers: MATLAB counts from 1, the file from 0."""
    polynomial = " ".join(f"{value:.17e}" for value in numbers["ss"])
    center = f"{numbers['xc_row_1based'] - 1:.15f} {numbers['yc_col_1based'] - 1:.15f}"
    return (
        f"#polynomial\n\n{len(numbers['ss'])} {polynomial} \n\n#inverse\n\n2 1.0 1.0 \n\n#center\n\n{center}\n\n"
        f"#affine\n\n{numbers['c']!r} {numbers['d']!r} {numbers['e']!r}\n\n#image size\n\n"
        f"{numbers['height']} {numbers['width']}\n\n"
    )


def board_in_camera(numbers: dict[str, Any], image: dict[str, Any], view: View) -> Array:
    """Return the corners (N, 3) [mm] in the camera's frame by [r1 r2 t] of the toolbox, which assumes a direct view."""
    plane = np.column_stack([numbers["Xt_mm"], numbers["Yt_mm"], np.ones(len(numbers["Xt_mm"]))])
    return np.asarray(plane @ np.array(image["RRfin_r1_r2_t"]).T * ((1, 1, -1) if view == "mirror" else (1, 1, 1)))


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_reproduces_the_toolbox_errors(shared_data: Path, key: str, view: View) -> None:
    numbers = reference(shared_data, key)
    camera = parse_ocam(text(numbers), view)
    assert camera.size == (1024, 768)
    for image, stored in zip(numbers["images"], numbers["stored_errMean_px"], strict=True):
        pixels = np.column_stack([image["col_1based"], image["row_1based"]]) - 1.0
        errors = np.linalg.norm(camera.project(board_in_camera(numbers, image, view)) - pixels, axis=1)
        assert errors.mean() == pytest.approx(stored, abs=1e-6)
