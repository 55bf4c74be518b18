"""The transform between two cameras by boards that both see: a consensus, and what does not take part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.board import BoardView
from calib.boards.board_pose import ambiguous_orders
from calib.errors import CalibError
from calib.fit.boards.relative_pose import initialise_relative_pose
from calib.fit.boards.rig_fit import fit_rig
from tests.calib.fit.boards.rig_views import EVEN, LOWER, ODD, T_UPPER_LOWER, UPPER, pairs, with_upper_order

CAMERAS = (LOWER, UPPER)


def test_the_consensus_is_the_transform_and_a_wrong_pair_is_rejected() -> None:
    seen = [view.seen for view in pairs(ODD, 6)]
    seen[2] = seen[2][0], seen[4][1]
    found = initialise_relative_pose(seen, ODD, CAMERAS)
    assert np.allclose(found.T_upper_lower, T_UPPER_LOWER, atol=1e-4)
    assert [number for number, _ in found.rejected] == [2] and "was the board moving?" in found.rejected[0][1]
    assert sorted(found.T_lower_board) == sorted(found.orders) == [0, 1, 3, 4, 5]


def test_the_order_of_the_corners_is_that_of_the_consensus() -> None:
    orders = ambiguous_orders(EVEN)
    views = [with_upper_order(view, orders[k % 2]) for k, view in enumerate(pairs(EVEN, 6))]
    found = initialise_relative_pose([view.seen for view in views], EVEN, CAMERAS)
    assert np.allclose(found.T_upper_lower, T_UPPER_LOWER, atol=1e-4)
    for k, view in enumerate(views):
        assert view.seen[1] is not None
        upper = view.seen[1].pixels[found.orders[k]]
        expected = UPPER.project(se3.apply(T_UPPER_LOWER @ found.T_lower_board[k], EVEN.points))
        assert np.allclose(upper, expected, atol=0.1)


def test_a_view_of_the_upper_camera_alone_has_its_board_in_the_lower_frame() -> None:
    views = pairs(ODD, 5)
    views[4] = replace(views[4], seen=(None, views[4].seen[1]))
    found = initialise_relative_pose([view.seen for view in views], ODD, CAMERAS)
    whole = initialise_relative_pose([view.seen for view in pairs(ODD, 5)], ODD, CAMERAS)
    assert np.allclose(found.T_lower_board[4], whole.T_lower_board[4], atol=1e-4) and 4 not in found.orders


def test_no_board_in_both_cameras_is_an_error() -> None:
    nothing = BoardView("x", np.full((len(ODD.points), 2), np.nan))
    with pytest.raises(CalibError, match="no board fits both cameras"):
        initialise_relative_pose([(pairs(ODD, 1)[0].seen[0], nothing)], ODD, CAMERAS)


def test_refuses_ambiguous_board_orientations() -> None:
    views = pairs(EVEN, 10)[:1] * 6
    with pytest.raises(CalibError, match="looks the same upside down"):
        fit_rig(views, EVEN, (LOWER, UPPER))
