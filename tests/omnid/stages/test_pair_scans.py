"""Scans of pairs of a base at rest: what is known through a loss of the pose, and without the height of the cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.obstacles.grid import FREE, OCCUPIED, REACH_CELLS, UNKNOWN
from omnid.core.obstacles.settings import ScanSettings
from omnid.messages import ObstacleScan, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.geometry import Geometry
from omnid.stages.obstacles import CameraFloor, PairScans
from omnid.tracking_state import TrackingState
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    Pole,
    panoramas,
    plain,
    stains,
    striped,
    worn,
)
from tests.simulation.rigs import make_rig

SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)
PERIOD_NS = 100_000_000


class Standing:
    """A base that does not move, with cameras so high over the floor."""

    def __init__(self, height_m: float, ahead_m: float = 0.0) -> None:
        T_base_rig = se3.transform(np.eye(3), [ahead_m, 0.0, height_m])
        rig = replace(make_rig(baseline_m=BASELINE_M), T_base_rig=T_base_rig)
        self.scans, self._floor, self._seq = (
            PairScans(Geometry(rig, CYLINDER), ScanSettings()),
            CameraFloor(rig, 0.0),
            0,
        )

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
        return self.scans.add(
            OdometryUpdate(self._seq, self._seq * PERIOD_NS, *of_pose, state, resets, 100, 100, StereoDepth(pair)),
            self._floor,
        )


def test_what_is_known_is_known_again_when_odometry_has_found_its_place_again() -> None:
    """A low thing that was seen from farther away: nothing shows it here, so that it would never be found again."""
    base = Standing(HEIGHT_M)
    pairs = [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)]
    for seq in range(20):
        base.scan(pairs[seq % 3])
    grid = base.scans.scans.grid
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


def test_grid_has_floor_before_a_wall_the_wall_and_nothing_known_behind() -> None:
    base, x_m = Standing(HEIGHT_M), 0.33
    for seed in range(6):
        scan = base.scan(Panoramas(0, 0, *panoramas(stains, 2.0, striped, seed=seed), SHOWN), x_m=x_m)
    assert scan.grid is not None
    ahead = scan.grid.at(np.array([[x_m + away_m, 0.0] for away_m in (0.0, 1.5, 2.6)]))
    assert scan.grid.states[ahead].tolist() == [FREE, FREE, UNKNOWN]
    row, columns = scan.grid.at(np.array([[x_m + 1.9, 0.0], [x_m + 2.1, 0.0]]))
    assert (scan.grid.states[row[0], columns[0] : columns[1] + 1] == OCCUPIED).any()
    assert scan.grid.age_s[ahead][1] == 0.0 and np.isinf(scan.grid.age_s[ahead][2])


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0])
def test_floor_between_edges_is_free_where_the_rig_states_its_height_and_nothing_is_elsewhere(height_m: float) -> None:
    scan = Standing(height_m).scan(Panoramas(0, 0, *panoramas(worn, 9.0, plain), SHOWN))
    assert np.isnan(scan.ranges_m).all()
    assert np.median(scan.free_m) > 2.0 if height_m else scan.free_m.max() == 0.0


def test_the_newest_pair_shows_a_pole_and_none_while_odometry_is_lost() -> None:
    base, pair = Standing(HEIGHT_M), Panoramas(0, 0, *panoramas(stains, 3.0, striped, thing=Pole(1.3, 0.05)), SHOWN)
    assert np.isinf(base.scans.thin_m).all()
    base.scan(pair)
    assert 1.0 < base.scans.thin_m[180] < 1.32 and (base.scans.thin_m[:170] > 2.0).all()
    base.scan(pair, TrackingState.LOST)
    assert np.isinf(base.scans.thin_m).all()


@pytest.mark.parametrize(("x_m", "y_m"), [(0.2, 0.0), (0.0, 0.24), (0.15, 0.2), (-0.15, -0.1)])
def test_what_is_known_stays_at_its_place_in_odom_as_the_base_moves(x_m: float, y_m: float) -> None:
    """A low thing nearer than the floor in view, one beside the base, and the free floor too near to be seen."""
    base, pairs = (
        Standing(HEIGHT_M),
        [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)],
    )
    for seq in range(6):
        base.scan(pairs[seq % 3])
    odds = base.scans.scans.grid.odds
    odds[REACH_CELLS - 6 : REACH_CELLS + 6, REACH_CELLS + 10 : REACH_CELLS + 13] = 6.0  # 0.5 m ahead
    odds[REACH_CELLS + 14 : REACH_CELLS + 17, REACH_CELLS - 6 : REACH_CELLS + 6] = 6.0  # 0.7 m to the left
    scan = base.scan(pairs[0], x_m=x_m, y_m=y_m)
    assert scan.ranges_m[180] == pytest.approx(0.575 - x_m, abs=0.04)
    assert scan.ranges_m[270] == pytest.approx(0.775 - y_m, abs=0.04)
    assert min(scan.free_m[0], scan.free_m[90]) > 1.5


def test_the_scan_goes_as_far_as_pairs_change_cells_in_all_directions() -> None:
    """Nothing is in the way up to there, whatever the heading of the base in odom."""
    pair = Panoramas(0, 0, *panoramas(worn, 9.0, plain), SHOWN)
    for heading_rad in (0.0, math.pi / 4):
        base = Standing(HEIGHT_M)
        free_m = [base.scan(pair, heading_rad=heading_rad).free_m for _ in range(6)][-1]
        assert free_m.max() == pytest.approx(4.5) and np.median(free_m) > 3.5
