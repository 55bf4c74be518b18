"""Rigs by boards: residuals by angle, the report, what a misfit costs; rigs by drives: other ones are refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.aprilgrid import find_april_grid
from calib.boards.board import AprilGrid, Board, BoardView
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards
from calib.fit.parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_from_drive import DriveAdjustment, DriveObservations, DriveState
from calib.fit.rig_uncertainty import DriveUncertainty
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.rig import Rig, RigCovariance, rig_between
from omnid.calibration.board_search import view_of_tags
from omnid.calibration.drive import require_same_rig
from omnid.calibration.images import PairedImages
from omnid.calibration.rig import accuracy_warnings
from omnid.calibration.rig_report import angle_lines, angle_rows, rig_report_html
from omnid.errors import OmnidError
from tests.simulation.boards import print_of
from tests.simulation.rigs import make_rig, nominal_rig, with_real_mirrors

BOARD, SIZE = Board(9, 6, 0.025), (640, 480)
LENS = OcamCamera((-230.0, 0.0, 1.5e-3, -6e-7, 1.6e-9), (238.0, 321.0), (1.0, 0.0, 0.0), SIZE, "direct")
# x of such a camera is down the rows: the upper one is 8 cm against it.
T_LOWER_UPPER = se3.exp([-0.08, 0.001, 0.002, 0.01, -0.02, 0.01])
NOISE_PX = 0.1


def calibrated(widest_deg: float) -> tuple[RigCalibration, Rig]:
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
            seen = [BoardView(str(len(views)), p + random.normal(0, NOISE_PX, p.shape)) for p in pixels]
            views.append(PairView(str(len(views)), (seen[0], seen[1])))
    found = calibrate_boards(views, BOARD, [SIZE, SIZE], "direct")
    return found, rig_between(*found.cameras, se3.inverse(found.T_upper_lower))


@pytest.fixture(scope="module")
def fitted() -> tuple[RigCalibration, Rig]:
    """Return the rig of boards up to 40 degrees from the axes."""
    return calibrated(40.0)


def test_residuals_are_told_by_the_angle_and_what_no_board_covered(fitted: tuple[RigCalibration, Rig]) -> None:
    for side in (0, 1):
        rows = angle_rows(*fitted, side)
        corners = sum(
            int(np.isfinite(seen.pixels[:, 0]).sum()) for view in fitted[0].views if (seen := view.seen[side])
        )
        assert [row.low_deg for row in rows] == [10 * number for number in range(len(rows))] and len(rows) >= 7
        assert sum(row.corners for row in rows) == corners
        assert all(row.rms_px == pytest.approx(NOISE_PX, rel=0.3) for row in rows if row.corners > 60)
        assert rows[-1].corners == 0 and len(rows[-1].uncovered) == rows[-1].visible
        assert 12 in rows[4].uncovered and not {3, 9} & set(rows[2].uncovered)
        lines = angle_lines("upper", rows)
        assert len(lines) == len(rows) + 2 and "60 to 70 deg" in lines[8] and "o'clock" in "".join(lines)


def test_the_report_of_lenses_that_look_ahead_is_written(fitted: tuple[RigCalibration, Rig]) -> None:
    found, rig = fitted
    blank = {view.name: np.full(SIZE[::-1], 90, np.uint8) for view in found.views}
    images = PairedImages((blank, blank))
    page = rig_report_html(found, images, [angle_rows(found, rig, side) for side in (0, 1)])
    assert page.count("<td>60 to 70 deg</td>") == 2 and page.count("<img") == 2


@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_tags_are_reflected_by_a_mirror(view: str) -> None:
    board = AprilGrid(5, 4, 0.08, 0.3)
    sheet = print_of(board)
    seen: list[BoardView] = []
    for turns in range(2):  # the second image sees the board on its side
        turned = np.ascontiguousarray(np.rot90(sheet if view == "direct" else sheet[:, ::-1], turns))
        found = find_april_grid(turned, board)
        assert found is not None
        seen.append(found)
    assert view_of_tags(None, seen, board) == view
    with pytest.raises(OmnidError, match="the tags show it as"):
        view_of_tags("direct" if view == "mirror" else "mirror", seen, board)


NOISE, MISFIT = ResidualStructure(0.01, 0.2), ResidualStructure(0.14, 0.2)


def lines(scale: float | None, *structures: ResidualStructure) -> list[str]:
    drives = None if scale is None else DriveUncertainty(scale, math.radians(0.01))
    return accuracy_warnings(structures, drives)


@pytest.mark.parametrize(("scale", "part"), [(0.001, "0.2 %"), (0.0015, "0.3 %"), (0.01, "2 %")])
def test_a_misfit_is_named_by_what_it_costs(scale: float, part: str) -> None:
    (line,) = lines(scale, NOISE, MISFIT)
    assert line.startswith("upper camera: ") and "systematic residuals of 0.140 px" in line
    assert f"wrong by {part} of their length and by 0.02 degree of heading per metre (two sigmas)" in line
    assert line.endswith("do not use it where that matters") == (scale >= 0.0015)


def test_errors_that_cost_little_are_no_warning_and_others_ask_for_pairs() -> None:
    assert lines(0.0005, MISFIT, MISFIT) == lines(0.0005, NOISE, NOISE) == lines(None, NOISE, NOISE) == []
    assert lines(None, MISFIT, NOISE)[0].startswith("lower camera: the camera model does not describe this camera")
    (line,) = lines(0.0006, NOISE, NOISE)
    assert line.startswith("the images leave something open: drives may be wrong by 0.12 %")
    assert line.endswith("; add pairs where the tables say `no board`")


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
    return DriveAdjustment(parameters, state, seen, np.diag((sigma / parameters.units) ** 2), 0.05, np.eye(len(steps)))


def changed(rig: Rig, changes: dict[str, float]) -> tuple[RigParameters, Array]:
    """Return the parameters of a rig and steps that change them."""
    found = adjusted(rig, **changes)
    return found.parameters, found.state.steps


@pytest.mark.parametrize(
    ("rig", "changes", "words"),
    [
        (MEASURED, {"r_x": np.deg2rad(3)}, "turned by 3.0 deg"),
        (MEASURED, {"e_y": np.deg2rad(-4)}, "baseline by 4.0 deg"),
        (nominal_rig(with_real_mirrors(MEASURED, 1)), {"r_x": np.deg2rad(5)}, "turned by 5.0 deg"),
        (MEASURED, {"lower_fu": 25.0, "lower_fv": 25.0}, "would change"),
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
