"""Tracking on panoramas that wrap around, and the turn between two of them."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.tracking import KltSettings, correlation_peaks, flow, track
from tests.omnid.core.scenery import texture, turned, wrapped

Array = NDArray[np.float64]

KLT = KltSettings()


def grid(width: int = 480, height: int = 120) -> Array:
    """Points (N, 2) all around, the seam included."""
    columns, rows = np.meshgrid(np.arange(0, width, 12.0), np.arange(24, height - 20, 16.0))
    return np.column_stack([columns.ravel(), rows.ravel()])


def column_error(found: Array, expected: Array, width: int = 480) -> Array:
    return np.asarray((found[:, 0] - expected[:, 0] + width / 2) % width - width / 2)


@pytest.mark.parametrize("columns", [0.0, 0.4, -3.3, 7.25])
def test_tracks_a_shift_to_a_twentieth_of_a_pixel_also_across_the_seam(columns: float) -> None:
    before, points = texture(1), grid()
    there, found = track(wrapped(before), wrapped(turned(before, columns)), points, points, KLT)
    assert found.mean() > 0.99
    error = column_error(there[found], points[found] + (columns, 0))
    assert np.median(np.abs(error)) < 0.02 and np.abs(error).max() < 0.05
    assert np.abs(there[found, 1] - points[found, 1]).max() < 0.05
    assert (there[:, 0] >= 0).all() and (there[:, 0] < 480).all()


def test_a_guess_extends_the_range() -> None:
    before, points = texture(2), grid()
    after = turned(before, 171)
    there, found = track(wrapped(before), wrapped(after), points, points + np.array([170.0, 0]), KLT)
    assert found.mean() > 0.98
    assert np.abs(column_error(there[found], points[found] + (171, 0))).max() < 0.05
    _, found = track(wrapped(before), wrapped(after), points, points, KLT)
    assert found.mean() < 0.2


def test_the_forward_backward_check_refuses_points_that_have_disappeared() -> None:
    before, points = texture(4), grid()
    after = before.copy()
    after[:, 200:280] = texture(5)[:, 200:280]
    inside = (points[:, 0] > 212) & (points[:, 0] < 268)
    _, reported = flow(wrapped(before), wrapped(after), points, points, KLT)
    _, found = track(wrapped(before), wrapped(after), points, points, KLT)
    assert reported[inside].mean() > 0.8
    assert found[inside].mean() < 0.2
    assert found[(points[:, 0] < 180) | (points[:, 0] > 300)].mean() > 0.98


ALL = np.ones((120, 480), bool)


@pytest.mark.parametrize("degrees", [0, 1.5, 18, -27, 90, -94.5, 135, 179.25, -180])
def test_any_turn_is_found_to_the_column(degrees: float) -> None:
    before = texture(1)
    after = turned(before, degrees / 360 * 480)
    found = correlation_peaks(before, after, ALL)[0]
    assert math.remainder(found - math.radians(degrees), 2 * math.pi) == pytest.approx(0, abs=1e-6)


def test_a_turn_to_the_left_is_positive_and_moves_the_image_right() -> None:
    """A point ahead is on the robot's right after a turn to the left, so right of the middle of the panorama."""
    cylinder = Cylinder(480, 120, 60.0)
    T_before_after = se3.exp([0, 0, 0, 0, 0, 0.5])
    ahead = np.array([[2.0, 0, 0]])
    moved = cylinder.pixels(se3.apply(se3.inverse(T_before_after), ahead)) - cylinder.pixels(ahead)
    assert moved[0, 0] == pytest.approx(0.5 * 480 / (2 * np.pi))
    assert correlation_peaks(texture(2), turned(texture(2), round(moved[0, 0])), ALL)[0] == pytest.approx(0.5, abs=0.01)


def test_structure_fixed_to_the_rig_holds_the_peak_at_zero_unless_left_out() -> None:
    before = np.asarray(texture(3) // 3 + 80, np.uint8)
    after = turned(before, 97)
    strut = np.zeros((120, 480), bool)
    strut[:, 40:60] = strut[:, 200:220] = strut[:, 360:380] = strut[100:] = True
    dots = 255 * np.random.default_rng(4).integers(0, 2, (120, 480)).astype(np.uint8)
    pattern = cv2.GaussianBlur(dots, (0, 0), 0.8)
    for image in (before, after):
        image[strut] = pattern[strut]
    usable = cv2.erode((~strut).astype(np.uint8), np.ones((5, 5))) > 0
    assert abs(correlation_peaks(before, after, ALL)[0]) < 0.05
    assert correlation_peaks(before, after, usable)[0] == pytest.approx(97 / 480 * 2 * math.pi)
