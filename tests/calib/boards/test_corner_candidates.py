"""Candidates for corners: each corner of a board with its two edges, and few of an image without one."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.corner_candidates import describe_corners, find_corners, sample, smoothed
from tests.calib.boards.sheets import sheet


@pytest.mark.parametrize(("angle_deg", "scale"), [(0.0, 1.0), (20.0, 0.5), (-35.0, 1.3)])
def test_every_corner_of_a_board_is_a_candidate(angle_deg: float, scale: float) -> None:
    seen = sheet(angle_deg, scale)
    found = find_corners(seen.image)
    apart = np.linalg.norm(found.pixels[:, None] - seen.pixels, axis=2)
    assert apart.min(axis=0).max() < 0.4 and len(found) < 2.5 * len(seen.pixels)
    assert (apart < 2.0).sum() == len(seen.pixels), "each one once"


def test_the_edges_of_a_corner_are_those_of_its_squares() -> None:
    seen = sheet(-20.0)
    found = describe_corners(smoothed(seen.image, 0.7), seen.pixels, 6.0)
    assert (found.quality > 0.5).all() and (found.contrast > 100).all()
    assert np.allclose(np.rad2deg(found.angles), (20.0, 110.0), atol=4)
    light = found.light.reshape(5, 6)
    assert (light[:, 1:] != light[:, :-1]).all() and (light[1:] != light[:-1]).all(), "squares alternate"


def test_edges_and_flat_parts_are_no_corners() -> None:
    stripes = np.tile(np.where(np.arange(200) // 10 % 2, 40, 200).astype(np.uint8), (200, 1))
    assert len(find_corners(stripes)) == 0 and len(find_corners(np.full((120, 130), 90, np.uint8))) == 0
    on_an_edge = np.array([[99.5, 100.0], [50.0, 109.5]])
    assert not describe_corners(smoothed(stripes, 0.7), on_an_edge, 4.0).quality.any()


def test_samples_are_between_the_pixels_and_repeat_the_border() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert sample(image, np.array([[[1.5, 0.0], [0.0, 0.5]], [[-5.0, 0.0], [9.0, 9.0]]])).tolist() == [
        [1.5, 2.0],
        [0.0, 11.0],
    ]
    assert sample(image, np.zeros((0, 2))).shape == (0,)
