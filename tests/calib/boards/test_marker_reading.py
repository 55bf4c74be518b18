"""Reading of a board's markers in mirror images by cv2.aruco, and the choice of those that lie as on the board."""

from __future__ import annotations

from calib.boards.marker_board import CharucoBoard
from calib.boards.marker_reading import consistent_markers

CHARUCO = CharucoBoard(6, 5, 0.05, 0.0375, "4X4_50")


def test_leaves_out_markers_that_lie_elsewhere() -> None:
    layout = CHARUCO.markers
    pixels = {int(number): 1000 * corners + 300 for number, corners in zip(layout.ids, layout.corners, strict=True)}
    moved = pixels | {4: pixels[4] + 37.0}
    assert sorted(consistent_markers(pixels, layout)) == sorted(pixels)
    assert sorted(consistent_markers(moved, layout)) == sorted(set(pixels) - {4})
