"""Views of cameras that are exposed at different times, corrected to one instant."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.stereo.triangulation import view
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

MODEL = StereoModel(Cylinder(1200, 360, 130.0), 0.2)
TWIST = np.array([0.7, -0.1, 0.05, 0.05, -0.1, 0.8])  # 0.7 m/s and 45 degrees/s
SIGMA = np.diag([0.1, 0.1, 0.1, 0.2, 0.2, 0.2])


def world(count: int = 300) -> Array:
    """Points (N, 3) of walls, floor and ceiling around the rig."""
    rng = np.random.default_rng(3)
    azimuth, r = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.8, 5.0, count)
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), r * rng.uniform(-0.6, 0.4, count)])


def rolling(line_s: float) -> NDArray[np.float32]:
    """Times (H, W) of a camera whose image rows run across the panorama."""
    rows, columns = np.mgrid[: MODEL.cylinder.height, : MODEL.cylinder.width]
    image_rows = 380 - (100 + 0.5 * rows) * np.cos(columns / MODEL.cylinder.focal_px)
    return (line_s * image_rows).astype(np.float32)


TIMES = [
    PixelTimes(0.015),
    PixelTimes(-0.02),
    PixelTimes(0.0, rolling(26e-6), rolling(26e-6)),
    PixelTimes(0.01, rolling(26e-6), rolling(20e-6)),
]


def seen(points: Array, times: PixelTimes, twist: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) in both panoramas of points (N, 3), each projected at its own time of exposure."""
    pixels = []
    for camera in (0, 1):
        at = view(points, MODEL.cylinder, MODEL.baseline_m)[:, [0, 1 + camera]]
        for _ in range(4):  # the time depends on the pixel
            tau = (times.upper if camera else times.lower)(at)
            moved = np.concatenate([se3.apply(se3.exp(-twist * t), p[None]) for t, p in zip(tau, points, strict=True)])
            at = view(moved, MODEL.cylinder, MODEL.baseline_m)[:, [0, 1 + camera]]
        pixels.append(at)
    return pixels[0], pixels[1]


@pytest.mark.parametrize("times", TIMES)
def test_views_are_corrected_to_the_instant_of_the_stamp(times: PixelTimes) -> None:
    points = world()
    truth = view(points, MODEL.cylinder, MODEL.baseline_m)
    lower, upper = seen(points, times, TWIST)
    exposure = Exposure(times, RigVelocity(TWIST, SIGMA**2), MODEL)
    shift = exposure.shift(points)
    for raw, moved, expected in ((lower, shift.lower, truth[:, :2]), (upper, shift.upper, truth[:, [0, 2]])):
        error = expected - raw - moved
        error[:, 0] = MODEL.cylinder.wrap(error[:, 0])
        assert np.abs(error).max() < 0.05  # the time is that of the nearest pixel
    assert np.abs(np.r_[shift.lower, shift.upper]).max() > 1.0, "the motion matters"
    # Without the points: from the pixels and rows that are measured.
    views, _ = exposure.corrected(lower, upper[:, 1])
    error = views - truth
    error[:, 0] = MODEL.cylinder.wrap(error[:, 0])
    assert np.abs(error).max() < 0.05
    columns, spread_px = exposure.upper_columns(lower, upper[:, 1])
    assert np.abs(MODEL.cylinder.wrap(columns - upper[:, 0])).max() < 0.05 and (spread_px > 0).all()
