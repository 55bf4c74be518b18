"""What limits a calibrated rig: the cost of its errors, and boards that are missing."""

from __future__ import annotations

import math

import pytest

from calib import se3
from calib.boards.board import BoardView
from calib.fit.boards.rig_problem import PairView
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty
from omnid.calibration.rig_notes import accuracy_warnings, missing_views
from tests.bench.calibration import BOARD, board_poses, board_rig

RIG = board_rig(21, 0.0)[0]
NOISE, MISFIT = ResidualStructure(0.01, 0.2), ResidualStructure(0.14, 0.2)


def lines(scale: float | None, *structures: ResidualStructure) -> list[str]:
    drives = None if scale is None else DriveUncertainty(scale, math.radians(0.01))
    return accuracy_warnings(structures, drives, "add 6 pairs with the board higher")


@pytest.mark.parametrize(("scale", "part"), [(0.001, "0.2 %"), (0.0015, "0.3 %"), (0.01, "2 %")])
def test_a_misfit_is_named_by_what_it_costs(scale: float, part: str) -> None:
    (line,) = lines(scale, NOISE, MISFIT)
    assert line.startswith("upper camera: ") and "systematic residuals of 0.140 px" in line
    assert f"wrong by {part} of their length and by 0.02 degree of heading per metre" in line
    assert line.endswith("do not use it where that matters") == (scale >= 0.0015)


def test_errors_that_cost_little_are_no_warning_and_others_say_which_views_are_missing() -> None:
    assert lines(0.0005, MISFIT, MISFIT) == lines(0.0005, NOISE, NOISE) == lines(None, NOISE, NOISE) == []
    assert lines(None, MISFIT, NOISE)[0].startswith("lower camera: the camera model does not describe this camera")
    (line,) = lines(0.0006, NOISE, NOISE)
    assert line.startswith("the images leave something open: drives may be wrong by 0.12 %")
    assert line.endswith("; add 6 pairs with the board higher")


def missing(higher: int) -> str:
    """Return what boards around the lower camera lack, with so many pairs of higher ones."""
    views = []
    for k, T in enumerate(board_poses(RIG, 21, higher)):
        seen = [m.camera.project(se3.apply(m.T_cam_rig @ T, BOARD.points)) for m in (RIG.lower, RIG.upper)]
        views.append(PairView(f"{k}", (BoardView(f"{k}", seen[0]), BoardView(f"{k}", seen[1]))))
    return missing_views(views, RIG)


def test_boards_around_the_lower_camera_are_too_low_for_the_upper_one() -> None:
    assert missing(0).startswith("the upper camera saw boards to an elevation of -")
    assert missing(0).endswith("add 6 pairs with the board higher, all around")
    before, after = (float(missing(more).split("elevation of ")[1].split(" deg")[0]) for more in (0, 6))
    assert after > before + 8
