"""Directions of the base in which the images show nothing to rely on."""

import math

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.obstacles.unwatched import Unwatched
from omnid.core.stereo.tiles import TILE_COLUMNS

CYLINDER = Cylinder(width=900, height=250, row0=80.0)
AHEAD = np.zeros(TILE_COLUMNS, bool)
AHEAD[27:33] = True  # 36 degrees about azimuth 0, which is in the middle of the panorama


def test_columns_are_sectors_about_the_same_azimuth() -> None:
    """The middle of the panorama is ahead, and azimuth falls from left to right."""
    unwatched = Unwatched(CYLINDER, np.eye(4))
    found = np.flatnonzero(unwatched.sectors(AHEAD))
    assert found.min() in (161, 162) and found.max() in (197, 198) and len(found) <= 38
    left = np.zeros(TILE_COLUMNS, bool)
    left[14] = True
    assert (np.flatnonzero(unwatched.sectors(left)) - 180 > 80).all()


def test_a_viewpoint_beside_the_origin_covers_near_and_far_directions() -> None:
    """Cameras 0.3 m to the left: what is ahead of them is to the left of the base where it is near."""
    T_base_rect = se3.transform(np.eye(3), [0.0, 0.3, 0.9])
    found = Unwatched(CYLINDER, T_base_rect).sectors(AHEAD)
    for range_m in (0.6, 1.2, 4.0):
        azimuth = math.atan2(0.3, range_m)
        assert found[math.floor((azimuth + math.pi) * SECTORS / math.tau)], range_m
