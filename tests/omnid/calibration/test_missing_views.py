"""Views that are missing: the camera whose boards do not reach the elevations of a drive, and where to hold them."""

from __future__ import annotations

from calib import se3
from calib.boards.board import BoardView
from calib.fit.boards.rig_problem import PairView
from calib.models.camera import Array
from omnid.calibration.missing_views import missing_views
from tests.bench.boards_chain import BOARD, board_poses, board_rig

RIG = board_rig(21, 0.0)[0]


def hint(poses: list[Array]) -> str:
    views = [
        PairView(
            f"{k}",
            (
                BoardView(f"{k}", RIG.lower.camera.project(se3.apply(RIG.lower.T_cam_rig @ T, BOARD.points)), 1.0),
                BoardView(f"{k}", RIG.upper.camera.project(se3.apply(RIG.upper.T_cam_rig @ T, BOARD.points)), 1.0),
            ),
        )
        for k, T in enumerate(poses)
    ]
    return missing_views(views, RIG)


def test_boards_around_the_lower_camera_are_too_low_for_the_upper_one() -> None:
    poses = board_poses(RIG, 21, 0)
    assert hint(poses).startswith("the upper camera saw boards to an elevation of -")
    assert hint(poses).endswith("add 6 pairs with the board higher, all around")


def test_higher_boards_lessen_what_is_missing() -> None:
    hints = [hint(board_poses(RIG, 21, more)) for more in (0, 6)]
    before, after = (float(line.split("elevation of ")[1].split(" deg")[0]) for line in hints)
    assert after > before + 8
