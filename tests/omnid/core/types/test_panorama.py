"""Columns of a panorama: a full turn wraps around, a sector has two ends."""

from __future__ import annotations

import numpy as np

from omnid.core.types.panorama import PaddedPanorama

PAD_PX, WIDTH = 8, 100
IMAGE = np.tile(np.arange(WIDTH + 2 * PAD_PX, dtype=np.uint8), (5, 1))
TURN = PaddedPanorama(IMAGE, PAD_PX)
SECTOR = PaddedPanorama(IMAGE, PAD_PX, period_px=360, first=300)
COLUMNS = np.array([-3.0, 0.0, 99.5, 103.0])


def test_the_panorama_is_without_its_padding() -> None:
    assert TURN.panorama.shape == (5, WIDTH) and TURN.panorama[0, 0] == PAD_PX
    assert np.shares_memory(IMAGE, TURN.panorama)
    assert (TURN.width, TURN.period_px) == (WIDTH, WIDTH) and (SECTOR.width, SECTOR.period_px) == (WIDTH, 360)


def test_a_full_turn_wraps_around() -> None:
    assert TURN.own(COLUMNS).tolist() == [97.0, 0.0, 99.5, 3.0]
    assert TURN.padded(COLUMNS).tolist() == [105.0, 8.0, 107.5, 11.0]
    own, known = TURN.unpadded(np.array([0.0, 8.0, 115.0]))
    assert own.tolist() == [92.0, 0.0, 7.0] and known.all()
    assert TURN.wrap(np.array([99.0, -51.0, 10.0])).tolist() == [-1.0, 49.0, 10.0]


def test_a_sector_has_two_ends_and_a_place_in_the_turn() -> None:
    assert SECTOR.own(COLUMNS).tolist() == COLUMNS.tolist()
    assert SECTOR.padded(np.array([-20.0, 0.0, 99.5, 200.0])).tolist() == [0.0, 8.0, 107.5, 115.0]
    own, known = SECTOR.unpadded(np.array([0.0, 8.0, 107.0, 115.0]))
    assert own.tolist() == [-8.0, 0.0, 99.0, 107.0] and known.tolist() == [False, True, True, False]
    assert SECTOR.in_turn(np.array([0.0, 70.0])).tolist() == [300.0, 10.0]
    assert SECTOR.wrap(np.array([359.0])).tolist() == [-1.0]
