"""`omnid.calibrate_camera`: one call from images to a camera that prints itself and is saved."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest

import omnid
from calib.camera_file import read_camera
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from omnid.calibration.board_search import find_boards
from omnid.calibration.camera import CameraResult
from tests.simulation.boards import BoardRenderer, board_poses_around_camera

BOARD = omnid.Board(6, 5, 0.03)
CAMERA = UnifiedCamera(0.9, (-110.0, 110.5), (178.3, 181.1), (360, 362))
MASK = Mask(CAMERA.center, 30.0, 172.0)
VIEWS = 4
lines: list[str] = []


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> CameraResult:
    """Calibrate by rendered images, as few as there may be, of which one is there twice."""
    folder = tmp_path_factory.mktemp("images")
    renderer = BoardRenderer.of(BOARD, CAMERA, MASK)
    for seed, T in enumerate(board_poses_around_camera(CAMERA, BOARD, MASK, VIEWS, distance_m=(0.14, 0.25))):
        cv2.imwrite(str(folder / f"p{seed}.png"), renderer.render_board(T, seed=seed).image)
    shutil.copy(folder / "p0.png", folder / "q.png")
    return omnid.calibrate_camera(folder, BOARD, model="ocam", progress=lines.append)


def test_the_result_prints_itself_in_one_line(found: CameraResult) -> None:
    line = str(found)
    assert line.startswith("model ocam, 360x362, centre 178.") and line.endswith(f"corners of {VIEWS} views")
    assert "\n" not in line and not found.is_misfit and found.mask is None


def test_progress_has_a_line_for_each_image_the_view_and_each_model(found: CameraResult) -> None:
    assert lines[0] == "left out q.png: the same image as p0.png"
    assert [line.split()[0] for line in lines[1:]] == [f"[{k}/{VIEWS}]" for k in range(1, VIEWS + 1)] + [
        "view:",
        "camera:",
    ]


def test_another_grid_in_more_images_than_the_board_is_named(found: CameraResult) -> None:
    """Part of a larger board may pass for the one that was asked for: then too few views are left, or wrong ones."""
    other, shown = omnid.Board(8, 5, 0.03), list[str]()
    renderer = BoardRenderer.of(other, CAMERA, MASK)
    poses = board_poses_around_camera(CAMERA, other, MASK, 2, distance_m=(0.2, 0.25))
    images = {f"other{seed}": renderer.render_board(T, seed=seed).image for seed, T in enumerate(poses)}
    views = find_boards({"p0": found.images["p0.png"], **images}, BOARD, thorough=True, progress=shown.append)
    assert [view.name for view in views] == ["p0"]
    assert shown[-1] == "the board was found in 1, a grid of 5x8 was found in 2: try --corners 5x8"


def test_what_is_saved_is_the_camera(found: CameraResult, tmp_path: Path) -> None:
    found.save(tmp_path / "camera.toml")
    read = read_camera(tmp_path / "camera.toml").camera
    assert read == found.calibration.camera
    assert read.center == pytest.approx(CAMERA.center, abs=0.3)


@pytest.mark.parametrize(("xi", "focal_px"), [(0.9, 230.0), (0.0, 350.0)])
def test_an_image_without_a_rim_is_that_of_a_lens_only_where_its_lines_are_straight(
    xi: float, focal_px: float, tmp_path: Path
) -> None:
    """The image of a mirror that is cropped inside its rim, light up to its corners, was taken for that of a lens."""
    camera = UnifiedCamera(xi, (-focal_px if xi else focal_px, focal_px), (159.5, 119.5), (320, 240))
    whole = Mask(camera.center, 0.0, 300.0)
    renderer = BoardRenderer.of(BOARD, camera, whole)
    inside, away_m = Mask(camera.center, 0.0, 119.0), (0.25, 0.4) if xi else (0.6, 0.9)
    poses = board_poses_around_camera(camera, BOARD, inside, VIEWS, distance_m=away_m, elevation_deg=(0.0, 20.0))
    for seed, T in enumerate(poses):
        cv2.imwrite(str(tmp_path / f"p{seed}.png"), renderer.render_board(T, seed=seed).image)
    if xi:
        with pytest.raises(omnid.OmnidError, match="add --view mirror or --view direct"):
            omnid.calibrate_camera([str(tmp_path)], BOARD, model="omni")
    else:
        found = omnid.calibrate_camera([str(tmp_path)], BOARD, model="ocam")
        assert found.calibration.camera.center == pytest.approx(camera.center, abs=2)


def test_the_same_image_again_is_no_further_view(found: CameraResult) -> None:
    assert list(found.images) == [f"p{k}.png" for k in range(VIEWS)]
    assert [line for line in found.warnings if "same image" in line] == ["left out q.png: the same image as p0.png"]
