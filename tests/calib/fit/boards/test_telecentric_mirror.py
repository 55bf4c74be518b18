"""Mirrors below telecentric lenses: the wavefront that the image tells, found by boards."""

from __future__ import annotations

from functools import cache

import pytest

from calib.boards.board import Board
from calib.fit.boards.rig_fit import RigCalibration, fit_rig
from calib.fit.boards.rig_selection import START_M, START_TANGENTIAL, telecentric_if_as_good
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.models.wavefront import TERMS
from calib.rig import Rig
from tests.bench.calibration import board_rig, projected_views

BOARD = Board(5, 4, 0.08)  # as large as one of 9 x 6 corners, with fewer of them to fit


def mirror(horizon_px: float, center: tuple[float, float], size: tuple[int, int], xi: float = 1.0) -> OcamCamera:
    """Return the camera below a paraboloid, or nearly the one of another xi; the terms of real mirrors are almost 0."""
    beta = (1 - xi) / (1 + xi)
    return OcamCamera(
        (-horizon_px / 2, 0.0, 0.5 * (1 - beta) / horizon_px, 0.0, 1e-13 - 0.5 * beta / horizon_px**3),
        (center[1], center[0]),
        (1.0, 0.0, 0.0),
        size,
        tangential=START_TANGENTIAL,
        wavefront=(START_M,) * TERMS,
    )


def freely_fitted(rig: Rig, perfect: Rig, xi: float = 1.0, pairs: int = 12) -> RigCalibration:
    starts = []
    for mounted in (perfect.lower, perfect.upper):
        assert isinstance(mounted.camera, UnifiedCamera)
        starts.append(mirror(abs(mounted.camera.focal[0]), mounted.camera.center, mounted.camera.size, xi))
    views = projected_views(rig, perfect, BOARD, pairs, 0.015, seed=21, noise_seed=[3])
    return fit_rig(views, BOARD, (starts[0], starts[1]))


@cache
def paraboloids() -> tuple[RigCalibration, RigCalibration]:
    """Return the fits of a rig of ray-traced mirrors: with free terms, and what is made of it."""
    free = freely_fitted(*board_rig(21, 1.0))
    return free, telecentric_if_as_good(free)


@pytest.mark.slow
def test_boards_of_paraboloids_give_the_profile_of_the_mirrors_twice_as_well() -> None:
    free, found = paraboloids()
    assert not free.telecentric and found.telecentric
    for one, other in zip(free.parameters, found.parameters, strict=True):
        assert [name for name, _, _ in one] == [name for name, _, _ in other]
        before, after = ({name: sigma for name, _, sigma in side} for side in (one, other))
        assert after["a4"] < 0.7 * before["a4"] and after["w_s"] < 0.5 * before["w_s"]
    assert len(found.covariance) == len(free.covariance)
