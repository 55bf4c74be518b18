"""Range scans of keyframes: low boxes before walls, tilted rigs, cameras whose height is not stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.settings import ScanSettings
from omnid.messages import DensePoints, ObstacleScan
from omnid.stages.obstacles import CameraFloor
from omnid.stages.places import keyframe_free, keyframe_scan
from tests.omnid.core.test_floor import HEIGHT_M, plane, walls
from tests.simulation.rigs import make_rig

BOX_M, WALL_M = 1.4, 2.4
AHEAD = np.abs(azimuths()) < 0.25  # of the rig, whose x is forward


def depth(T_rig_level: np.ndarray, with_floor: bool = True) -> DensePoints:
    """Return the points of a room in the rig frame: a wall, the floor, and a box 0.4 m high ahead with a tenth of the
    points that the wall above it has.
    """
    rng = np.random.default_rng(1)
    parts = [walls(30_000, rng, WALL_M), plane(3000 if with_floor else 0, rng)]
    parts[0] = parts[0][(np.abs(np.arctan2(parts[0][:, 1], parts[0][:, 0])) > 0.3) | (parts[0][:, 2] > -0.7)]
    angle = rng.uniform(-0.3, 0.3, 250)
    low = np.column_stack([BOX_M * np.cos(angle), BOX_M * np.sin(angle), rng.uniform(-HEIGHT_M, 0.4 - HEIGHT_M, 250)])
    points = se3.apply(T_rig_level, np.vstack([*parts, low]))
    return DensePoints(np.zeros((0, 0), np.float32), np.zeros((0, 2)), points, 1e-4 * (points**2).sum(axis=1) ** 2)


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0], ids=["stated", "not stated"])
@pytest.mark.parametrize("tilt_deg", [0.0, 0.8])
def test_a_low_box_before_a_wall_is_the_nearest_obstacle(height_m: float, tilt_deg: float) -> None:
    tilt = se3.transform(se3.rotation_exp(np.deg2rad([0.0, tilt_deg, 0.0])), np.zeros(3))
    stated = se3.transform(np.eye(3), [0.0, 0.0, height_m])
    # A stated pose holds the tilt as well.
    rig = replace(make_rig(), T_base_rig=stated @ se3.inverse(tilt) if height_m else np.eye(4))
    camera_floor, seen = CameraFloor(rig, 0.0), depth(tilt)
    camera_floor.add(seen)
    scan = keyframe_scan(seen, camera_floor, np.eye(4), ScanSettings())
    np.testing.assert_allclose(scan[AHEAD], BOX_M, atol=0.08)
    np.testing.assert_allclose(scan[np.abs(azimuths()) > 0.5], WALL_M, atol=0.15)
    assert bool(camera_floor.summary()) != bool(height_m)


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0])
def test_free_floor_ends_at_what_is_narrow_and_is_negative_there(height_m: float) -> None:
    stated = se3.transform(np.eye(3), [0.0, 0.0, height_m])
    unknown = np.full(SECTORS, np.nan, np.float32)
    free_m, narrow_m = np.full(SECTORS, 2.0, np.float32), np.full(SECTORS, np.inf, np.float32)
    narrow_m[[1, 3]] = 1.5, 3.0
    scan = ObstacleScan(0, 0, unknown, unknown, free_m, np.eye(4), (), unwatched=())
    found = keyframe_free(scan, narrow_m, CameraFloor(replace(make_rig(), T_base_rig=stated), 0.0), np.eye(4))
    expected = [2.0, -1.5, 2.0, -2.0, 2.0] if height_m else [0.0] * 5
    np.testing.assert_allclose(found[:5], expected, atol=1e-3)


def test_without_a_floor_nothing_is_known_and_the_summary_names_it() -> None:
    camera_floor, seen = CameraFloor(make_rig(), 0.0), depth(np.eye(4), with_floor=False)
    camera_floor.add(seen)
    assert np.isnan(keyframe_scan(seen, camera_floor, np.eye(4), ScanSettings())).all()
    assert "call nothing free" in camera_floor.summary()
