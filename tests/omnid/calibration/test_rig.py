"""Rigs by boards: residuals by angle, the report; rigs by drives: other ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.aprilgrid import find_april_grid
from calib.boards.board import AprilGrid, Board
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards
from calib.fit.parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.fit.rig_from_drive import DriveAdjustment, DriveObservations, DriveState
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.rig import Rig, RigCovariance
from omnid.calibration.board_search import view_of_tags
from omnid.calibration.drive import require_same_rig
from omnid.calibration.images import PairedImages
from omnid.calibration.rig_report import angle_lines, angle_rows, rig_report_html
from omnid.errors import OmnidError
from tests.simulation.boards import print_of
from tests.simulation.rigs import make_rig, nominal_rig, with_real_mirrors

BOARD, SIZE = Board(9, 6, 0.025), (640, 480)
LENS = OcamCamera((-230.0, 0.0, 1.5e-3, -6e-7, 1.6e-9), (238.0, 321.0), (1.0, 0.0, 0.0), SIZE, "direct")
# x of such a camera is down the rows: the upper one is 8 cm against it.
T_LOWER_UPPER = se3.exp([-0.08, 0.001, 0.002, 0.01, -0.02, 0.01])
NOISE_PX = 0.1


def calibrated(widest_deg: float) -> RigCalibration:
    """Return a rig fitted to corners of boards up to an angle from the axes, left and right, but not above."""
    random, views = np.random.default_rng(2), list[PairView]()
    while len(views) < 24:
        angle, azimuth = np.deg2rad(random.uniform(0, widest_deg)), random.uniform(0.6, 2 * np.pi - 0.6)
        ahead = np.array([-np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), -np.cos(angle)])
        turn = se3.rotation_exp(random.normal(0, 0.35, 3)) @ np.diag([1.0, -1.0, -1.0])
        T = se3.transform(turn, 0.25 * ahead) @ se3.transform(np.eye(3), -BOARD.points.mean(axis=0))
        pixels = [
            LENS.project(se3.apply(T_cam_lower @ T, BOARD.points))
            for T_cam_lower in (np.eye(4), se3.inverse(T_LOWER_UPPER))
        ]
        if all(np.isfinite(p).all() and (p > 2).all() and (p < np.array(SIZE) - 3).all() for p in pixels):
            seen = [p + random.normal(0, NOISE_PX, p.shape) for p in pixels]
            views.append(PairView(str(len(views)), (seen[0], seen[1])))
    return calibrate_boards(views, BOARD, [SIZE, SIZE], "direct")


@pytest.fixture(scope="module")
def fitted() -> RigCalibration:
    """Return the rig of boards up to 40 degrees from the axes."""
    return calibrated(40.0)


def test_residuals_are_reported_by_the_angle_that_boards_covered(fitted: RigCalibration) -> None:
    for side in (0, 1):
        rows = angle_rows(fitted, side)
        corners = sum(
            int(np.isfinite(seen[:, 0]).sum()) for view in fitted.views if (seen := view.seen[side]) is not None
        )
        assert 4 <= len(rows) <= 7 and sum(int(count) for _, count, _ in rows) == corners
        assert all(float(rms) == pytest.approx(NOISE_PX, rel=0.3) for _, count, rms in rows if int(count) > 60)
        lines = angle_lines("upper", rows)
        assert len(lines) == len(rows) + 2 and "30 to 40 deg" in lines[5]


def test_the_report_of_lenses_that_look_ahead_is_written(fitted: RigCalibration) -> None:
    blank = {view.name: np.full(SIZE[::-1], 90, np.uint8) for view in fitted.views}
    page = rig_report_html(fitted, PairedImages((blank, blank)))
    assert page.count("<td>30 to 40 deg</td>") == 2 and page.count("<img") == 2


@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_tags_are_reflected_by_a_mirror(view: str) -> None:
    board = AprilGrid(5, 4, 0.08, 0.3)
    sheet = print_of(board)
    seen = []
    for turns in range(2):  # the second image sees the board on its side
        turned = np.ascontiguousarray(np.rot90(sheet if view == "direct" else sheet[:, ::-1], turns))
        found = find_april_grid(turned, board)
        assert found is not None
        seen.append(found)
    assert view_of_tags(None, seen, board) == view
    with pytest.raises(OmnidError, match="the tags show it as"):
        view_of_tags("direct" if view == "mirror" else "mirror", seen, board)


# Rigs of a drive


MEASURED = make_rig(misaligned_deg=(0.6, -0.4, 0.5))
MEASURED = replace(MEASURED, covariance=RigCovariance.of_matrix(("r_x",), np.eye(1) * 1e-8))


def adjusted(rig: Rig, sigma: float = 0.01, **changes: float) -> DriveAdjustment:
    """Return an adjustment that changes parameters by the given numbers of their own units."""
    parameters = RigParameters.about(rig, times=(UPPER_DELAY, LINE_TIME))
    named = {name.replace(" ", "_").split("_[")[0]: k for k, name in enumerate(parameters.names)}
    steps = np.zeros(len(parameters.names))
    for name, change in changes.items():
        steps[named[name]] = change / parameters.units[named[name]]
    none = np.zeros(0, np.intp)
    seen = DriveObservations(none, none, none, np.zeros((0, 2)))
    state = DriveState(np.eye(4)[None], np.zeros((0, 3)), np.zeros((1, 6)), np.zeros(1), steps)
    return DriveAdjustment(parameters, state, seen, np.diag((sigma / parameters.units) ** 2), 0.05)


def changed(rig: Rig, changes: dict[str, float]) -> tuple[RigParameters, Array]:
    """Return the parameters of a rig and steps that change them."""
    found = adjusted(rig, **changes)
    return found.parameters, found.state.steps


@pytest.mark.parametrize(
    ("rig", "changes", "words"),
    [
        (MEASURED, {"r_x": np.deg2rad(7)}, "r_x would change"),
        (MEASURED, {"e_y": np.deg2rad(-9)}, "e_y would change"),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_x": np.deg2rad(7)}, "r_x would change"),
        (MEASURED, {"lower_fu": 25.0, "lower_fv": 25.0}, "lower f. would change"),
    ],
)
def test_another_rig_is_refused(rig: Rig, changes: dict[str, float], words: str) -> None:
    with pytest.raises(OmnidError, match=words) as raised:
        require_same_rig(*changed(rig, changes))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("rig", "changes"),
    [
        (MEASURED, {"r_x": np.deg2rad(1.5), "e_y": np.deg2rad(1), "lower_fu": 5.0, "upper_xi": 0.02, "upper_pv": 5.0}),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_y": np.deg2rad(-4)}),
    ],
)
def test_the_same_rig_is_accepted(rig: Rig, changes: dict[str, float]) -> None:
    require_same_rig(*changed(rig, changes))
