"""The shape of a print: lengths are kept, modes are derivatives, the sag is measured from the plane."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.boards.print_shape import AS_DRAWN, MODE_UNITS, PrintShape

BOARD = Board(7, 6, 0.03)
BENT = PrintShape((2e-3, -1e-3, 0.5e-3, 3e-3))


def test_modes_are_the_derivatives_of_the_points() -> None:
    modes = BENT.modes(BOARD.points)
    assert modes is not None
    for k, step in enumerate(1e-4 * np.eye(4)):
        ahead, behind = (BENT.moved(sign * step).points(BOARD.points) for sign in (1, -1))
        # The points move inwards by the square of the bend, which the modes leave out.
        np.testing.assert_allclose((ahead - behind) / 2e-4, modes[:, :, k], atol=0.06 * MODE_UNITS[k])


def test_only_the_kept_modes_are_free() -> None:
    assert AS_DRAWN.modes(BOARD.points) is None and AS_DRAWN.is_as_drawn
    bent, stretched = PrintShape((1e-3, 0.0, 0.0, 0.0)), PrintShape((0.0, 0.0, 0.0, 1e-3))
    assert bent.free.tolist() == [True, True, True, False] and stretched.free.tolist() == [False, False, False, True]
    assert stretched.moved(np.array([0.1])).stretch == pytest.approx(2e-3)


def test_a_bent_sheet_keeps_its_lengths() -> None:
    fine = np.column_stack([np.linspace(-0.03, 0.21, 2000), np.full(2000, 0.04), np.zeros(2000)])
    bent = PrintShape((3e-3, 0.0, 0.0, 0.0)).points_of(BOARD.points, fine)
    length = np.linalg.norm(np.diff(bent, axis=0), axis=1).sum()
    assert length == pytest.approx(0.24, rel=2e-6)


def test_the_sag_is_that_of_the_corners_above_a_plane() -> None:
    assert PrintShape((0.8e-3, 0.0, 0.0, 0.0)).sag_m(BOARD.points) == pytest.approx(0.8e-3, rel=0.01)
    assert PrintShape((0.0, 0.0, 0.4e-3, 0.0)).sag_m(BOARD.points) == pytest.approx(0.8e-3)
    assert AS_DRAWN.sag_m(BOARD.points) == 0.0
