"""Camera models: equations, round trips, numbers by hand, NaN for what is not seen; OCamCalib's files; real mirrors."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.importers import parse_ocam
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, EquirectangularCamera
from calib.models.ocam import OcamCamera, View
from calib.models.unified import UnifiedCamera
from calib.rig import Rig

BENT = (-0.02, 0.004, 1e-3, -5e-4)
CAMERAS: dict[str, OmniCamera] = {
    **{f"omni xi {xi}": UnifiedCamera(xi, (-207.0, 213.0), (380.0, 390.0), (768, 770)) for xi in (0.0, 0.6, 1.0)},
    "omni xi 1.7": UnifiedCamera(1.7, (-507.0, 513.0), (380.0, 390.0), (768, 770)),
    "omni bent": UnifiedCamera(0.95, (-207.0, 213.0), (380.0, 390.0), (768, 770), BENT),
    "ocam mirror": OcamCamera((-131.6, 0, 1.9e-3, 9e-8, -6e-10), (382.4, 514.6), (0.999, 2e-3, -3e-3), (1024, 768)),
    "ocam direct": OcamCamera(
        (-300.0, 0, 1.4e-3, -1.6e-6, 4e-9), (470.0, 650.0), (1.001, 1e-3, 2e-3), (1280, 960), "direct"
    ),
    "ocam tangential": OcamCamera(
        (-131.6, 0, 1.9e-3, 9e-8, -6e-10), (382.4, 514.6), (0.999, 2e-3, -3e-3), (1024, 768), "mirror", (3e-6, -5e-6)
    ),
    "ds": DoubleSphereCamera(-0.27, 0.55, (310.0, 315.0), (380.0, 390.0), (768, 770)),
    "ds near a pinhole": DoubleSphereCamera(0.1, 0.2, (310.0, 315.0), (380.0, 390.0), (768, 770)),
    "equidistant": EquidistantCamera((-0.012, 0.003, -0.001, 0.0002), (225.0, 228.0), (380.0, 390.0), (768, 770)),
    "equirectangular": EquirectangularCamera((200.0, 190.0), (380.0, 120.0), (768, 300)),
    "ocam turning": OcamCamera((-100.0, 0, 1e-3, 0, -1e-8), (300.0, 310.0), (1.0, 0.0, 0.0), (600, 600)),
}
# Distortions that turn back within the image.
TURNING: dict[str, OmniCamera] = {
    "omni once": UnifiedCamera(0.0, (460.0, 460.0), (376.0, 240.0), (752, 480), (-0.3, 0.0, 0.0, 0.0)),
    "omni twice": UnifiedCamera(0.9, (-420.0, 420.0), (376.0, 240.0), (752, 480), (-0.3, 0.03, 0.02, -0.03)),
    "ocam sideways": OcamCamera(
        (-180.0, 0, 1.4e-3, 0, 2e-9), (384.0, 384.0), (1.001, 1e-4, -1e-4), (768, 768), "mirror", (3e-4, -2e-4)
    ),
}


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> OmniCamera:
    return CAMERAS[request.param]


def pixels_of(camera: OmniCamera) -> Array:
    u, v = np.meshgrid(np.linspace(0, camera.size[0] - 1, 61), np.linspace(0, camera.size[1] - 1, 53))
    return np.column_stack([u.ravel(), v.ravel()])


def test_project_inverts_lift_at_any_distance(camera: OmniCamera) -> None:
    pixels = pixels_of(camera)
    rays = camera.lift(pixels)
    seen = np.isfinite(rays).all(axis=1)
    assert seen.mean() > 0.4
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1, rtol=0, atol=1e-12)
    distance = np.random.default_rng(0).uniform(0.01, 100, (len(pixels), 1))
    np.testing.assert_allclose(camera.project(rays * distance)[seen], pixels[seen], rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", TURNING)
def test_two_rays_never_share_a_pixel(name: str) -> None:
    camera = TURNING[name]
    rays = np.random.default_rng(2).normal(size=(5000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = camera.project(rays)
    seen = (pixels >= 0).all(axis=1) & (pixels <= camera.size).all(axis=1)
    found, rays = camera.lift(pixels[seen]), rays[seen]
    at_the_turn = np.isnan(found).any(axis=1)  # where Newton steps hardly converge
    assert len(rays) > 500 and at_the_turn.mean() < 0.01
    np.testing.assert_allclose(found[~at_the_turn], rays[~at_the_turn], rtol=0, atol=1e-5)
    lifted = camera.lift(pixels_of(camera))
    lifted = lifted[np.isfinite(lifted).all(axis=1)]
    assert np.isfinite(camera.project(lifted)).all() and len(lifted) > 500


@pytest.mark.parametrize(("view", "sign"), [("mirror", 1.0), ("direct", -1.0)])
def test_ocam_projection_equals_the_equations(view: str, sign: float) -> None:
    camera = OcamCamera(
        (-100.0, 0.0, 0.002),
        (240.0, 320.0),
        (1.01, 0.02, -0.03),
        (640, 480),
        "mirror" if view == "mirror" else "direct",
    )
    x, y = 60.0, -80.0  # rho = 100, f = -100 + 20 = -80
    row, column = 1.01 * x + 0.02 * y + 240, -0.03 * x + y + 320
    ray = np.array([[x, y, sign * 80.0]])
    np.testing.assert_allclose(camera.lift(np.array([[column, row]])), ray / np.linalg.norm(ray), rtol=0, atol=1e-12)
    np.testing.assert_allclose(camera.project(ray), [[column, row]], rtol=0, atol=1e-9)
    assert camera.center == (320.0, 240.0)


def test_mask_is_a_ring_without_the_zero_pixels_of_its_image() -> None:
    image = np.full((40, 60), 255, np.uint8)
    image[:, 40] = 0
    mask = Mask((30.0, 20.0), 3.0, 15.0, image)
    pixels = np.array([[30, 20], [34, 20], [30, 34], [30, 36], [40, 20], [np.nan, 1]], float)
    assert mask.contains(pixels).tolist() == [False, True, True, False, False, False]
    assert mask.contains(pixels, 2.0).tolist() == [False] * 6


def test_omni_projection_equals_the_equations() -> None:
    camera = UnifiedCamera(0.5, (-200.0, 300.0), (100.0, 50.0), (640, 480), (0.1, 0.2, 0.01, 0.02))
    mx, my = (2 / 3) / (1 / 3 + 0.5), (-2 / 3) / (1 / 3 + 0.5)  # of the unit ray (2, -2, 1) / 3
    r2 = mx * mx + my * my
    radial = 1 + 0.1 * r2 + 0.2 * r2 * r2
    x = mx * radial + 2 * 0.01 * mx * my + 0.02 * (r2 + 2 * mx * mx)
    y = my * radial + 0.01 * (r2 + 2 * my * my) + 2 * 0.02 * mx * my
    (pixel,) = camera.project(np.array([[4.0, -4.0, 2.0]]))
    np.testing.assert_allclose(pixel, [100 - 200 * x, 50 + 300 * y], rtol=0, atol=1e-9)


def test_lens_projections_equal_the_equations() -> None:
    """One point (3, -4, 2): distance sqrt(29), distance from the axis 5."""
    point, size = np.array([[3.0, -4.0, 2.0]]), (2000, 2000)
    d1 = math.sqrt(29)
    shifted = -0.2 * d1 + 2
    under = 0.6 * math.sqrt(25 + shifted**2) + 0.4 * shifted
    (pixel,) = DoubleSphereCamera(-0.2, 0.6, (300.0, 310.0), (900.0, 950.0), size).project(point)
    np.testing.assert_allclose(pixel, [900 + 300 * 3 / under, 950 - 310 * 4 / under], rtol=0, atol=1e-9)
    t = math.atan2(5, 2)
    radius = t + 0.01 * t**3 - 0.02 * t**5 + 0.003 * t**7 - 0.0004 * t**9
    (pixel,) = EquidistantCamera((0.01, -0.02, 0.003, -0.0004), (300.0, 310.0), (900.0, 950.0), size).project(point)
    np.testing.assert_allclose(pixel, [900 + 300 * radius * 0.6, 950 - 310 * radius * 0.8], rtol=0, atol=1e-9)


def test_the_axis_is_projected_to_the_centre_and_invalid_points_to_nan(camera: OmniCamera) -> None:
    axis = camera.lift(np.array([camera.center]))
    assert abs(axis[0, 2]) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(camera.project(3 * axis), [camera.center], rtol=0, atol=1e-6)
    invalid = np.array([[0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], -3 * axis[0]])
    if isinstance(camera, EquirectangularCamera):  # it sees what is behind it
        invalid = invalid[:3]
    with np.errstate(invalid="ignore"):  # numpy's own warnings of infinite points
        assert np.isnan(camera.project(invalid)).any(axis=1).all()
        assert np.isnan(camera.lift(np.array([[np.nan, 3.0], [np.inf, 1.0]]))).any(axis=1).all()


# Results of OCamCalib, and cameras of real mirrors


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
def test_the_model_reproduces_the_toolbox_errors(shared_data: Path, key: str, view: View) -> None:
    numbers = reference(shared_data, key)
    camera = parse_ocam(text(numbers), view)
    assert camera.size == (1024, 768)
    for image, stored in zip(numbers["images"], numbers["stored_errMean_px"], strict=True):
        pixels = np.column_stack([image["col_1based"], image["row_1based"]]) - 1.0
        errors = np.linalg.norm(camera.project(board_in_camera(numbers, image, view)) - pixels, axis=1)
        assert errors.mean() == pytest.approx(stored, abs=1e-6)


WAVEFRONT = (2e-4, -1e-4, -3e-4, 4e-4, 5e-5)


def with_terms(rig: Rig, view: str = "mirror") -> OcamCamera:
    camera = rig.lower.camera
    assert isinstance(camera, OcamCamera)
    return replace(camera, view=view, tangential=(1e-6, -2e-6), astigmatism=(3e-10, -2e-10), wavefront=WAVEFRONT)


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
