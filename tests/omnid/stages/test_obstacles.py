"""Scans of pairs and keyframes: a rendered run, a base at rest, low boxes before walls, cameras of unknown height."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.rig_file import read_rig
from omnid.config import ObstaclesConfig, load_config
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.grid import FREE, OCCUPIED, REACH_CELLS, UNKNOWN
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.stereo.tiles import TILE_COLUMNS
from omnid.core.types.panorama import Panoramas
from omnid.messages import DensePoints, ObstacleScan, OdometryUpdate, StereoDepth
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.encoder import Outgoing
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import keyframe_ranges
from omnid.stages.obstacles import Obstacles, floor_frame, sectors_of
from omnid.tracking_state import TrackingState
from tests.omnid.core import test_floor
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    panoramas,
    plain,
    stains,
    striped,
    worn,
)
from tests.omnid.core.test_floor import plane, walls
from tests.simulation.rigs import make_rig

RANGES_M = (0.3, 0.6, 1.2, 2.5, 5.0, math.inf)


class Scans:
    """The scans of a run."""

    def __init__(self) -> None:
        self.scans: list[ObstacleScan] = []

    def process(self, message: Outgoing) -> None:
        """Keep a scan."""
        if isinstance(message, ObstacleScan):
            self.scans.append(message)


def scans_of(scene: Path) -> list[ObstacleScan]:
    """Return the scans of a rendered run."""
    found, config = Scans(), load_config(None, ["places.enabled=false"])
    rig = read_rig(scene / "rig.toml")
    if rig.height_m(config.obstacles.scan.floor_m) is None:
        rig = rig.at_height(test_floor.HEIGHT_M)
    run_log(scene / "log.mcap", config, ReplayOptions(rig=rig, inline=True, observer=lambda *_: found))
    return found.scans


def test_the_walls_of_the_corridor_are_left_and_right(scene: Path) -> None:
    found = scans_of(scene)
    # Left wall between 0.9 and 1.6 m, right wall between 0.8 and 1.4 m from the middle; see corridor().
    scan = found[len(found) // 2]
    left, right = scan.ranges_m[260:280], scan.ranges_m[80:100]
    assert np.isfinite(left).any() and np.isfinite(right).any()
    assert 0.6 < np.nanmedian(left) < 2.0 and 0.5 < np.nanmedian(right) < 1.8
    assert np.isfinite(scan.ranges_m).sum() > 150


SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)
PERIOD_NS = 100_000_000


class BaseAtRest:
    """A base that does not move, with cameras at a height above the floor."""

    def __init__(self, height_m: float, ahead_m: float = 0.0) -> None:
        T_base_rig = se3.transform(np.eye(3), [ahead_m, 0.0, height_m])
        rig = replace(make_rig(baseline_m=BASELINE_M), T_base_rig=T_base_rig)
        self.obstacles, self._seq = Obstacles(Geometry(rig, CYLINDER), ObstaclesConfig()), 0

    def scan(
        self,
        pair: Panoramas,
        state: TrackingState = TrackingState.TRACKING,
        resets: int = 0,
        heading_rad: float = 0.0,
        x_m: float = 0.0,
        y_m: float = 0.0,
    ) -> ObstacleScan:
        """Return the scan at the next pair."""
        self._seq += 1
        T_odom_rig = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading_rad]))
        T_odom_rig[:2, 3] = x_m, y_m
        of_pose = T_odom_rig, np.eye(6), np.zeros(6), np.eye(6)
        return self.obstacles.scan(
            OdometryUpdate(self._seq, self._seq * PERIOD_NS, *of_pose, state, resets, 100, 100, StereoDepth(pair))
        )


def test_the_grid_is_valid_again_when_odometry_recognises_its_landmarks() -> None:
    """A low object that was seen from farther away: no image shows it here, so that it would never be found again."""
    base = BaseAtRest(HEIGHT_M)
    pairs = [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)]
    for seq in range(20):
        base.scan(pairs[seq % 3])
    grid = base.obstacles.scans.grid
    middle = REACH_CELLS
    grid.odds[middle - 6 : middle + 6, middle + 8 : middle + 11] = 6.0
    grid.odds[middle + 39 : middle + 42, middle - 3 : middle + 3] = 6.0  # 2 m to the left
    ranges_m = []
    for seq, state in enumerate((TrackingState.TRACKING, TrackingState.LOST, TrackingState.DEGRADED)):
        scan = base.scan(pairs[seq], state)
        ranges_m.append(float(scan.ranges_m[180]))
        if state is TrackingState.LOST:
            assert np.isnan(scan.ranges_m).all() and not scan.free_m.any()
    assert ranges_m == pytest.approx([0.475, np.nan, 0.475], abs=0.03, nan_ok=True)
    begun_again = base.scan(pairs[0], resets=1)
    assert begun_again.ranges_m[180] == pytest.approx(0.475, abs=0.03)
    assert scan.ranges_m[270] == pytest.approx(2.0, abs=0.1) and not begun_again.ranges_m[270] < 2.5


def test_the_grid_has_free_floor_before_a_wall_the_wall_and_unknown_cells_behind_it() -> None:
    base, x_m = BaseAtRest(HEIGHT_M), 0.33
    for seed in range(6):
        scan = base.scan(Panoramas(0, 0, *panoramas(stains, 2.0, striped, seed=seed), SHOWN), x_m=x_m)
    assert scan.grid is not None
    ahead = scan.grid.at(np.array([[x_m + away_m, 0.0] for away_m in (0.0, 1.5, 2.6)]))
    assert scan.grid.states[ahead].tolist() == [FREE, FREE, UNKNOWN]
    row, columns = scan.grid.at(np.array([[x_m + 1.9, 0.0], [x_m + 2.1, 0.0]]))
    assert (scan.grid.states[row[0], columns[0] : columns[1] + 1] == OCCUPIED).any()


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0])
def test_floor_between_edges_is_free_where_the_rig_states_its_height_and_nothing_is_elsewhere(height_m: float) -> None:
    scan = BaseAtRest(height_m).scan(Panoramas(0, 0, *panoramas(worn, 9.0, plain), SHOWN))
    assert np.isnan(scan.ranges_m).all()
    assert np.median(scan.free_m) > 2.0 if height_m else scan.free_m.max() == 0.0


@pytest.mark.parametrize(("x_m", "y_m"), [(0.15, 0.2), (-0.15, -0.1)])
def test_known_cells_stay_at_their_place_in_odom_as_the_base_moves(x_m: float, y_m: float) -> None:
    """A low object nearer than the floor in view, one next to the base, and the free floor too near to be seen."""
    base = BaseAtRest(HEIGHT_M)
    pairs = [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)]
    for seq in range(6):
        base.scan(pairs[seq % 3])
    odds = base.obstacles.scans.grid.odds
    odds[REACH_CELLS - 6 : REACH_CELLS + 6, REACH_CELLS + 10 : REACH_CELLS + 13] = 6.0  # 0.5 m ahead
    odds[REACH_CELLS + 14 : REACH_CELLS + 17, REACH_CELLS - 6 : REACH_CELLS + 6] = 6.0  # 0.7 m to the left
    scan = base.scan(pairs[0], x_m=x_m, y_m=y_m)
    assert scan.ranges_m[180] == pytest.approx(0.575 - x_m, abs=0.04)
    assert scan.ranges_m[270] == pytest.approx(0.775 - y_m, abs=0.04)
    assert min(scan.free_m[0], scan.free_m[90]) > 1.5


DEAD = np.zeros(TILE_COLUMNS, bool)
DEAD[27:33] = True  # 36 degrees about azimuth 0, which is in the middle of the panorama


def test_columns_of_tiles_are_sectors_about_the_same_azimuth() -> None:
    """The middle of the panorama is ahead, and azimuth falls from left to right."""
    found = np.flatnonzero(sectors_of(DEAD, CYLINDER, np.eye(4), RANGES_M))
    assert found.min() in (161, 162) and found.max() in (197, 198) and len(found) <= 38
    left = np.zeros(TILE_COLUMNS, bool)
    left[14] = True
    assert (np.flatnonzero(sectors_of(left, CYLINDER, np.eye(4), RANGES_M)) - 180 > 80).all()


def test_tiles_of_a_viewpoint_next_to_the_origin_cover_near_and_far_directions() -> None:
    """Cameras 0.3 m to the left: what is ahead of them is to the left of the base where it is near."""
    found = sectors_of(DEAD, CYLINDER, se3.transform(np.eye(3), [0.0, 0.3, 0.9]), RANGES_M)
    for range_m in (0.6, 1.2, 4.0):
        azimuth = math.atan2(0.3, range_m)
        assert found[math.floor((azimuth + math.pi) * SECTORS / math.tau)], range_m


ROOM_HEIGHT_M = test_floor.HEIGHT_M
BOX_M, WALL_M = 1.4, 2.4
AHEAD = np.abs(azimuths()) < 0.25  # of the rig, whose x is forward
UNKNOWN_M = np.full(SECTORS, np.nan, np.float32)
NO_SCAN = ObstacleScan(0, 0, UNKNOWN_M, UNKNOWN_M, np.zeros(SECTORS, np.float32), np.eye(4))


def depth(T_rig_level: np.ndarray) -> DensePoints:
    """Return the points of a room in the rig frame: a wall, the floor, and a box 0.4 m high ahead with a tenth of the
    points that the wall above it has.
    """
    rng = np.random.default_rng(1)
    parts = [walls(30_000, rng, WALL_M), plane(3000, rng)]
    parts[0] = parts[0][(np.abs(np.arctan2(parts[0][:, 1], parts[0][:, 0])) > 0.3) | (parts[0][:, 2] > -0.7)]
    angle = rng.uniform(-0.3, 0.3, 250)
    low = np.column_stack(
        [BOX_M * np.cos(angle), BOX_M * np.sin(angle), rng.uniform(-ROOM_HEIGHT_M, 0.4 - ROOM_HEIGHT_M, 250)]
    )
    points = se3.apply(T_rig_level, np.vstack([*parts, low]))
    return DensePoints(np.zeros((0, 0), np.float32), np.zeros((0, 2)), points, 1e-4 * (points**2).sum(axis=1) ** 2)


@pytest.mark.parametrize("tilt_deg", [0.0, 0.8])
def test_a_low_box_before_a_wall_is_the_nearest_obstacle(tilt_deg: float) -> None:
    tilt = se3.transform(se3.rotation_exp(np.deg2rad([0.0, tilt_deg, 0.0])), np.zeros(3))
    stated = se3.transform(np.eye(3), [0.0, 0.0, ROOM_HEIGHT_M])
    rig = replace(make_rig(), T_base_rig=stated @ se3.inverse(tilt))  # a stated pose holds the tilt as well
    scan, _ = keyframe_ranges(depth(tilt), NO_SCAN, floor_frame(rig, 0.0), np.eye(4), ScanSettings())
    np.testing.assert_allclose(scan[AHEAD], BOX_M, atol=0.08)
    np.testing.assert_allclose(scan[np.abs(azimuths()) > 0.5], WALL_M, atol=0.15)


def test_without_a_height_nothing_is_known() -> None:
    floor = floor_frame(make_rig(), 0.0)
    scan, _ = keyframe_ranges(depth(np.eye(4)), NO_SCAN, floor, np.eye(4), ScanSettings())
    assert np.isnan(scan).all()
