"""Coverage of a camera's image by the boards seen so far."""

from __future__ import annotations

import math

import numpy as np

from calib.boards.board import BoardView
from calib.models.camera import Mask
from omnid.calibration.coverage import HOURS, CameraCoverage

RIM = Mask((100.0, 120.0), 10.0, 100.0)


def at(hour: float, radius: float) -> BoardView:
    """Return a small board about a place of the image, like the hand of a clock."""
    angle = 2 * math.pi * hour / HOURS
    middle = np.array(RIM.center) + radius * np.array([math.sin(angle), -math.cos(angle)])
    return BoardView("", np.vstack([middle, middle + 0.5, [math.nan, math.nan]]))


def test_hours_and_rings_are_those_of_a_clock_in_the_image() -> None:
    coverage = CameraCoverage(RIM)
    for hour, radius in ((12, 15), (3, 60), (9, 95)):
        coverage.add(at(hour, radius))
    counts = coverage.counts()
    assert [tuple(place) for place in np.argwhere(counts)] == [(0, 0), (1, 3), (2, 9)]
    assert coverage.missing() == [
        "no board at 1, 2, 4 to 8, 10, 11 o'clock",
        "one ring only: hold it nearer, farther, higher, lower",
    ]


def test_enough_is_all_hours_and_two_rings() -> None:
    coverage = CameraCoverage(RIM)
    for hour in range(1, 13):
        coverage.add(at(hour, 60))
    assert coverage.missing() == ["one ring only: hold it nearer, farther, higher, lower"]
    for hour in range(1, 7):
        coverage.add(at(2 * hour, 20))
    assert coverage.missing() == []
