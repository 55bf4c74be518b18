"""OCamCalib's results by its file's conventions, and cameras of real mirrors: wavefronts, near projection."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.importers import parse_ocam
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View
from calib.models.wavefront import offsets
from calib.rig import Rig
from tests.simulation.rigs import MirrorCamera

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


WAVEFRONT = (2e-4, -1e-4, -3e-4, 4e-4, 5e-5)
MIRROR = MirrorCamera(207.0, (383.5, 383.5), (768, 768), tilt_rad=(0.009, -0.008), conic=0.015, ellipticity=-0.012)


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
