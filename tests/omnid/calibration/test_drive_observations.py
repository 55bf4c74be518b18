"""Drives that cannot tell a rig are refused, with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.calibration.drive_observations import require_motion
from omnid.errors import OmnidError
from tests.simulation.paths import loop, spline_path, turns


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (loop(1, 14), "only 14 views"),
        (turns([12.0] * 30, 0.0), "the path is 0.0 m long"),
        (spline_path(1, 60, 0.1, sway_m=0.05), "turn by less than 60 deg"),
    ],
)
def test_drives_that_are_too_short_or_straight_are_refused(poses: np.ndarray, words: str) -> None:
    with pytest.raises(OmnidError, match=words):
        require_motion(se3.inverse(poses), 1)


def test_a_round_is_enough() -> None:
    require_motion(se3.inverse(loop(1, 40)), 1)
