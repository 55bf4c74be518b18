"""Yaw hypotheses: circular correlation and the paper's steps."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.tracking import correlation_peaks
from tests.omnid.core.scenery import texture, turned

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
