"""AprilTag grids: sizes, detection in rendered mirror images, hidden parts."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.aprilgrid import AprilGrid, find_april_grid
from calib.errors import CalibError
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.sensor import Sensor
from tests.simulation.boards import board_poses_around_camera, frame_board, print_of, render_april_grid

MASK = Mask((241.3, 237.8), 40.0, 232.0)
MOUNTED = MountedCamera(UnifiedCamera(0.9, (-150.0, 151.0), MASK.center, (480, 480)), np.eye(4), MASK)
GRID = AprilGrid(4, 3, 0.06, 0.3)


@pytest.mark.parametrize(("hidden", "least", "most"), [(0.0, 0.7, 1.0), (0.5, 0.25, 0.55)])
def test_finds_the_visible_corners_in_a_mirror(hidden: float, least: float, most: float) -> None:
    T = board_poses_around_camera(MOUNTED.camera, frame_board(GRID), MASK, 1, seed=3, distance_m=(0.25, 0.3))[0]
    made = render_april_grid(MOUNTED, GRID, T, seed=1, sensor=Sensor(noise_sigma=2.0), hidden=hidden)
    view = find_april_grid(made.image, GRID, "name")
    assert view is not None and view.name == "name" and least <= np.isfinite(view.pixels[:, 0]).mean() <= most
    off = np.linalg.norm(view.pixels - made.corners, axis=1)
    assert np.nanmedian(off) < 0.05 and np.nanpercentile(off, 90) < 0.3


def test_tags_elsewhere_than_on_the_grid_are_no_grid() -> None:
    image = np.ascontiguousarray(print_of(AprilGrid(3, 4, 0.06, 0.3))[:, ::-1])
    assert find_april_grid(image, AprilGrid(3, 4, 0.06, 0.3)) is not None
    assert find_april_grid(image, AprilGrid(9, 2, 0.06, 0.9)) is None
    assert find_april_grid(np.full((100, 100), 90, np.uint8), GRID) is None


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ((6, 6, float("nan"), 0.3), "tags of 0.1 mm to 10 m"),
        ((6, 6, 0.08, 24.0), "like Kalibr's tagSpacing, found 24"),
        ((30, 30, 0.08, 0.3), "expected 1 to 587 tags, .* found 30x30"),
    ],
)
def test_refuses_impossible_grids(sizes: tuple[int, int, float, float], words: str) -> None:
    with pytest.raises(CalibError, match=words):
        AprilGrid(*sizes)
