"""Options of boards: `omnid calibrate camera` with a ChArUco board and an AprilTag grid, and what users do wrong."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.camera_file import read_camera
from omnid.cli import main
from omnid.simulation.rendering.sensor import Sensor
from tests.calib.boards.test_marker_finder import CHARUCO, FEW_MARKERS, GRID, MOUNTED
from tests.simulation.boards import board_poses_around_camera
from tests.simulation.marker_boards import frame_board, print_of, render_marker_board

VIEWS = 6
CHARUCO_WORDS = ["--board", "charuco", "--corners", "6x5", "--square-mm", "50", "--marker-mm", "37.5"]
GRID_WORDS = ["--board", "aprilgrid", "--tags", "4x3", "--tag-mm", "60", "--tag-spacing", "0.3"]


def write_views(folder: Path, board: MarkerBoard) -> None:
    """Write images of a board; a card hides half of it in every third one."""
    assert MOUNTED.mask is not None
    poses = board_poses_around_camera(
        MOUNTED.camera, frame_board(board), MOUNTED.mask, VIEWS, seed=5, distance_m=(0.24, 0.32)
    )
    for k, T in enumerate(poses):
        made = render_marker_board(MOUNTED, board, T, seed=k, sensor=Sensor(noise_sigma=1.5), hidden=0.5 * (k % 3 == 1))
        cv2.imwrite(str(folder / f"{k}.png"), made.image)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("board", "words"), [(CHARUCO, [*CHARUCO_WORDS, "--dictionary", "DICT_4X4_50"]), (GRID, GRID_WORDS)]
)
def test_calibrates_with_half_hidden_boards(
    board: CharucoBoard | AprilGrid, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_views(tmp_path, board)
    output = tmp_path / "camera.toml"
    assert (
        main(
            [
                "calibrate",
                "camera",
                str(tmp_path),
                *words,
                "--model",
                "omni",
                "-o",
                str(output),
                "--report",
                str(tmp_path / "report.html"),
            ]
        )
        == 0
    )
    assert f"of {len(board.points)} corners" in capsys.readouterr().err
    camera = read_camera(output).camera
    rays = MOUNTED.camera.lift(np.array([[400.0, 240.0], [120.0, 300.0], [240.0, 90.0]]))
    np.testing.assert_allclose(camera.project(rays), MOUNTED.camera.project(rays), atol=0.3)
    assert str(board) in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--corners", "6x5"], "--board checkerboard: expected --corners, --square-mm, found no --square-mm"),
        (["--corners", "6x5", "--square-mm", "0"], "expected squares of 0.1 mm to 10 m, found 0 mm"),
        (["--board", "aprilgrid", "--corners", "6x5"], "--tags, --tag-mm, --tag-spacing, found no --tags, --tag-mm"),
        (
            ["--corners", "6x5", "--square-mm", "30", "--dictionary", "4X4_50"],
            "--dictionary belongs to another kind of board",
        ),
        ([*CHARUCO_WORDS, "--dictionary", "4X4"], "expected a dictionary of markers"),
        ([*CHARUCO_WORDS, "--dictionary", "4X4_50", "--tags", "2x2"], "--tags belongs to another kind of board"),
        (["--board", "aprilgrid", "--tags", "6x6", "--tag-mm", "80", "--tag-spacing", "24"], "Kalibr's tagSpacing"),
    ],
)
def test_names_what_is_wrong_with_the_options(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "camera", str(tmp_path), *words, "-o", str(tmp_path / "camera.toml")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_names_the_dictionary_that_was_seen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.ascontiguousarray(print_of(FEW_MARKERS)[0][:, ::-1]))
    words = ["4x3" if word == "6x5" else word for word in CHARUCO_WORDS]
    words += ["--dictionary", "5X5_50", "--quiet"]
    assert main(["calibrate", "camera", str(tmp_path), *words, "-o", str(tmp_path / "c.toml")]) == 2
    assert "try --dictionary 4X4_50" in capsys.readouterr().err
