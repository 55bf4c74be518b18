"""Links between neighbours: four at an inner corner, which lead back."""

from __future__ import annotations

import numpy as np

from calib.boards.corner_candidates import describe_corners, smoothed
from calib.boards.corner_links import NO_NEIGHBOUR, link_neighbours
from tests.calib.boards.sheets import BOARD, sheet


def test_corners_are_linked_to_those_beside_them() -> None:
    seen = sheet()
    grey = smoothed(seen.image, 0.7)
    neighbour, back = link_neighbours(grey, describe_corners(grey, seen.pixels, 6.0))
    counts = (neighbour != NO_NEIGHBOUR).sum(axis=1).reshape(BOARD.rows, BOARD.columns)
    assert (counts[1:-1, 1:-1] == 4).all() and counts[0, 0] == 2 and (counts[0, 1:-1] == 3).all()
    for corner, arm in np.argwhere(neighbour != NO_NEIGHBOUR):
        other = neighbour[corner, arm]
        assert abs(other - corner) in (1, BOARD.columns)
        assert neighbour[other, back[corner, arm]] == corner and back[other, back[corner, arm]] == arm


def test_corners_on_two_boards_are_not_linked() -> None:
    seen = sheet()
    beside = np.hstack([seen.image, seen.image])
    pixels = np.vstack([seen.pixels, seen.pixels + np.array([seen.image.shape[1], 0])])
    grey = smoothed(beside, 0.7)
    neighbour, _ = link_neighbours(grey, describe_corners(grey, pixels, 6.0))
    first = neighbour[: len(seen.pixels)]
    assert (first[first != NO_NEIGHBOUR] < len(seen.pixels)).all()


def test_an_edge_that_is_not_seen_is_no_link() -> None:
    seen = sheet(0.0)
    (u, v), right = seen.corners[2, 2].round().astype(int), BOARD.columns * 2 + 3
    grey = smoothed(seen.image, 0.7)
    corners = describe_corners(grey, seen.pixels, 6.0)
    assert right in link_neighbours(grey, corners)[0][right - 1]
    grey[v - 10 : v + 11, u + 4 : u + 21] = 128
    assert right not in link_neighbours(grey, corners)[0][right - 1]


def test_one_candidate_has_no_neighbour() -> None:
    seen = sheet()
    grey = smoothed(seen.image, 0.7)
    neighbour, back = link_neighbours(grey, describe_corners(grey, seen.pixels[:1], 6.0))
    assert (neighbour == NO_NEIGHBOUR).all() and (back == NO_NEIGHBOUR).all()
