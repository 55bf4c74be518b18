"""Views of cameras that are exposed at different times, corrected to one instant."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.odometry.pose_estimation import SharedError, gauss_newton
from omnid.core.stereo.triangulation import triangulate, view
from omnid.core.types.pixel_times import AT_ONCE, PixelTimes
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


def test_the_derivative_is_that_of_the_shift() -> None:
    points, times = world(20), TIMES[3]
    shift = Exposure(times, RigVelocity(TWIST, SIGMA**2), MODEL).shift(points)
    for k in range(6):
        step = 1e-3 * np.eye(6)[k]
        more, less = (Exposure(times, RigVelocity(TWIST + s * step, SIGMA**2), MODEL).shift(points) for s in (1, -1))
        numeric = np.column_stack([more.lower - less.lower, (more.upper - less.upper)[:, ::-1]]) / 2e-3
        np.testing.assert_allclose(shift.by_motion[:, :, k], numeric, atol=0.1 * np.abs(numeric).max() + 1e-3)


def test_the_noise_of_the_views_is_that_of_an_unknown_velocity() -> None:
    """Corrected by a wrong velocity, views err as their noise says."""
    points, times = world(), TIMES[0]
    truth = view(points, MODEL.cylinder, MODEL.baseline_m)
    lower, upper = seen(points, times, TWIST)
    rng, z2 = np.random.default_rng(1), []
    for _ in range(40):
        believed = RigVelocity(TWIST + SIGMA @ rng.standard_normal(6), SIGMA**2)
        views, noise = Exposure(times, believed, MODEL).corrected(lower, upper[:, 1])
        z2.append((views - truth)[:, 2] ** 2 / noise[:, 2, 2])
    assert 0.7 < np.sqrt(np.mean(z2)) < 1.3


def test_velocity_and_pose_are_estimated_together() -> None:
    """The rows of a rolling shutter tell the velocity where the landmarks are known."""
    points, times = world(), TIMES[2]
    lower, upper = seen(points, times, TWIST)
    believed = RigVelocity(TWIST + np.array([0.05, -0.05, 0.02, 0.1, -0.1, 0.1]), SIGMA**2)
    shift = Exposure(times, believed, MODEL).shift(points)
    views = np.column_stack([lower + shift.lower, upper[:, 1] + shift.upper[:, 1]])
    shared = SharedError(shift.by_motion[:, :3], SIGMA**2)
    fixed, free = (
        gauss_newton(points, np.zeros((len(points), 3, 3)), views, np.eye(4), MODEL, shared=error)
        for error in (None, shared)
    )
    errors = [np.abs(se3.log(result.T)).max() for result in (fixed, free)]
    assert errors[1] < 0.2 * errors[0]
    assert np.abs(believed.twist + free.shared - TWIST).max() < 0.02
    assert np.trace(free.covariance) > np.trace(fixed.covariance)


def test_points_that_cannot_be_triangulated_stay_as_they_are() -> None:
    exposure = Exposure(TIMES[0], RigVelocity(TWIST, SIGMA**2), MODEL)
    pixels = np.array([[100.0, 50.0], [200.0, 60.0]])
    views, noise = exposure.corrected(pixels, np.array([48.0, np.nan]))  # diverging rays; not found
    assert not np.isfinite(triangulate(views, MODEL.cylinder, MODEL.baseline_m)).any()
    np.testing.assert_array_equal(views[:, :2], pixels)
    assert (noise == 0).all()


def test_an_exposure_at_once_leaves_views_as_they_are_seen() -> None:
    """A frame whose pixels are all exposed at the stamp takes the same steps as others, to the last bit."""
    exposure = Exposure.of(AT_ONCE, RigVelocity(TWIST, SIGMA**2), MODEL)
    points = np.array([[2.0, 1.0, 0.5], [-1.0, 3.0, -0.2]])
    views = view(points, MODEL.cylinder, MODEL.baseline_m)
    pixels, disparity = views[:, :2], views[:, 2] - views[:, 1]
    shift = exposure.shift(points)
    assert not shift.lower.any() and not shift.upper.any() and shift.by_motion.shape == (2, 4, 0)
    assert not shift.noise(exposure.motion).any() and not shift.column_sigma(exposure.motion).any()
    corrected, noise = exposure.corrected(pixels, views[:, 2])
    assert corrected.tobytes() == views.tobytes() and not noise.any() and exposure.derivatives(views).shape == (2, 3, 0)
    columns, spread_px = exposure.upper_columns(pixels, views[:, 2])
    assert columns.tobytes() == pixels[:, 0].tobytes() and not spread_px.any()
    upper, spread_px = exposure.upper_pixels(pixels, disparity)
    np.testing.assert_array_equal(upper, np.column_stack([pixels[:, 0], pixels[:, 1] + disparity]))
    assert not spread_px.any() and exposure.is_known
    assert not Exposure.of(PixelTimes(0.015), exposure.motion, MODEL).times.is_at_once
