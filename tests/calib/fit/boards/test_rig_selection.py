"""Rigs of ray-traced mirrors: the terms of real mirrors are selected, also from a poor polynomial camera."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board, BoardView
from calib.fit.boards.camera_selection import SelectedCalibration, select_calibration
from calib.fit.boards.rig_problem import PairView
from calib.fit.boards.rig_selection import SelectedRig, select_rig
from calib.models.ocam import OcamCamera
from calib.rig import Rig
from omnid.simulation.rendering.rigs import make_rig
from tests.simulation.boards import board_poses_around_rig
from tests.simulation.rigs import with_real_mirrors

BOARD = Board(9, 6, 0.05)
PERFECT = make_rig(baseline_m=0.18)


def views(rig: Rig, count: int, noise_px: float = 0.015) -> list[PairView]:
    rng, made = np.random.default_rng(1), []
    for k, T in enumerate(board_poses_around_rig(PERFECT, BOARD, count, seed=1, distance_m=(0.3, 0.7))):
        both = [m.camera.project(se3.apply(m.T_cam_rig @ T, BOARD.points)) for m in (rig.lower, rig.upper)]
        lower, upper = (BoardView(f"p{k:02}", px + noise_px * rng.standard_normal(px.shape)) for px in both)
        made.append(PairView(f"p{k:02}", (lower, upper)))
    return made


def selected(seen: list[PairView]) -> SelectedRig:
    sides: list[SelectedCalibration] = []
    for side in (0, 1):
        one = [board for view in seen if (board := view.seen[side]) is not None]
        sides.append(select_calibration(one, BOARD, PERFECT.lower.camera.size, "ocam"))
    assert sides[0].polynomial and sides[1].polynomial
    return select_rig(
        seen,
        BOARD,
        (sides[0].calibration.camera, sides[1].calibration.camera),
        (sides[0].polynomial, sides[1].polynomial),
    )


@pytest.mark.slow
def test_terms_of_real_mirrors_are_selected_for_real_mirrors() -> None:
    found = selected(views(with_real_mirrors(PERFECT, 3), 10))
    assert [score.name for score in found.scores] == ["cameras below paraboloids", "central cameras"]
    assert isinstance(found.calibration.lower, OcamCamera) and any(found.calibration.lower.wavefront)
    assert found.scores[0].held_out_px < 0.021 < 0.5 * found.scores[1].held_out_px
    assert {"s1", "w_s"} < {name for name, _, _ in found.calibration.parameters[1]}
