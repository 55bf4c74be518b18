"""Likelihood of a scan: largest at the pose where it was taken, small outside the free space of the map."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, Grid
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.places.beam_model import BEAMS, NOT_FREE, BeamModel
from tests.omnid.core.mapping.rooms import box, pose, scan_of

CELL_M = 0.05
MARGIN = 20  # unknown cells around the walls
LOW, HIGH = (-3.0, -2.0), (4.0, 2.5)
AT = (0.5, -0.3, 0.4)
SCAN = scan_of(box(LOW, HIGH), pose(*AT))


def room() -> Grid:
    """A rectangle with walls one cell wide, free inside, in unknown space."""
    size = [round((high - low) / CELL_M) for low, high in zip(LOW, HIGH, strict=True)]
    cells = np.full((size[1] + 2 * MARGIN, size[0] + 2 * MARGIN), UNKNOWN, np.int8)
    cells[MARGIN - 1 : 1 - MARGIN, MARGIN - 1 : 1 - MARGIN] = OCCUPIED
    cells[MARGIN:-MARGIN, MARGIN:-MARGIN] = FREE
    return Grid(cells, CELL_M, (LOW[0] - MARGIN * CELL_M, LOW[1] - MARGIN * CELL_M))


@pytest.mark.parametrize("coarse", [False, True])
def test_the_right_pose_is_the_likeliest(coarse: bool) -> None:
    offsets = [(0, 0, 0), (0.3, 0, 0), (0, -0.3, 0), (0, 0, 0.2), (0, 0, np.pi)]
    found = BeamModel(room()).log_likelihood(np.array(AT) + np.array(offsets), SCAN, coarse=coarse)
    assert np.argmax(found) == 0 and found[0] - np.sort(found)[-2] > 0.5


def test_beams_fit_at_the_right_pose_only() -> None:
    model = BeamModel(room())
    assert model.fitting(np.array(AT), SCAN) > 0.95 and model.fitting(np.array([*AT[:2], AT[2] + 0.8]), SCAN) < 0.7
    assert model.fitting(np.array(AT), np.full(SECTORS, np.nan, np.float32)) == 0


def test_a_pose_without_free_space_is_unlikely_and_a_scan_of_nothing_says_nothing() -> None:
    model, outside = BeamModel(room()), np.array([[99.0, 99.0, 0.0]])
    assert model.log_likelihood(outside, SCAN)[0] < NOT_FREE + 0.2 * BEAMS * np.log(0.11)
    assert model.log_likelihood(outside, np.full(SECTORS, np.nan, np.float32)).tolist() == [0.0]


def test_poses_are_drawn_from_free_cells_with_all_headings() -> None:
    model = BeamModel(room())
    drawn = model.drawn(500, np.random.default_rng(1))
    assert drawn.shape == (500, 3) and ((drawn[:, :2] > LOW) & (drawn[:, :2] < HIGH)).all()
    assert np.ptp(drawn[:, 0]) > 6.0 and np.ptp(drawn[:, 1]) > 3.8 and np.ptp(drawn[:, 2]) > 6.0
    assert model.free_m2 == pytest.approx((HIGH[0] - LOW[0]) * (HIGH[1] - LOW[1]), rel=0.05)
    nothing = BeamModel(Grid(np.full((4, 4), UNKNOWN, np.int8), CELL_M, (0.0, 0.0)))
    assert nothing.drawn(5, np.random.default_rng(1)).shape == (0, 3) and nothing.free_m2 == 0
