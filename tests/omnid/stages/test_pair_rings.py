"""Rings of pairs of a base at rest: what is known through a loss of the pose, and without the height of the cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.obstacles.cell_kernels import SURFACE
from omnid.core.obstacles.grid import CELL_M
from omnid.core.obstacles.settings import RingSettings
from omnid.messages import ObstacleRing, OdometryUpdate, Panoramas, StereoDepth
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.floor import CameraFloor
from omnid.stages.geometry import Geometry
from omnid.stages.pair_rings import PairRings
from omnid.tracking_state import TrackingState
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

SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)
PERIOD_NS = 100_000_000


class Standing:
    """A base that does not move, with cameras so high over the floor."""

    def __init__(self, height_m: float) -> None:
        T_base_rig = se3.transform(np.eye(3), [0.0, 0.0, height_m])
        rig = replace(make_rig(baseline_m=BASELINE_M), T_base_rig=T_base_rig)
        self.rings, self._floor, self._seq = (
            PairRings(Geometry(rig, CYLINDER), RingSettings()),
            CameraFloor(rig, 0.0),
            0,
        )

    def ring(self, pair: Panoramas, state: TrackingState = TrackingState.TRACKING, resets: int = 0) -> ObstacleRing:
        """Return the ring at the next pair."""
        self._seq += 1
        of_pose = np.eye(4), np.eye(6), np.zeros(6), np.eye(6)
        return self.rings.add(
            OdometryUpdate(self._seq, self._seq * PERIOD_NS, *of_pose, state, resets, 100, 100, StereoDepth(pair)),
            self._floor,
        )


def test_what_is_known_is_known_again_when_odometry_has_found_its_place_again() -> None:
    """A low thing that was seen from farther away: nothing shows it here, so that it would never be found again."""
    base = Standing(HEIGHT_M)
    pairs = [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)]
    for seq in range(20):
        base.ring(pairs[seq % 3])
    grid = base.rings._grid
    corner = np.round(grid.corner_m / CELL_M).astype(int)
    grid._odds[SURFACE, -corner[1] - 6 : -corner[1] + 6, -corner[0] + 8 : -corner[0] + 11] = 6.0
    ranges_m = []
    for seq, state in enumerate((TrackingState.TRACKING, TrackingState.LOST, TrackingState.DEGRADED)):
        ring = base.ring(pairs[seq], state)
        ranges_m.append(float(ring.ranges_m[180]))
        if state is TrackingState.LOST:
            assert np.isnan(ring.ranges_m).all() and not ring.free_m.any()
    assert ranges_m == pytest.approx([0.43, np.nan, 0.43], abs=0.03, nan_ok=True)
    begun_again = base.ring(pairs[0], resets=1)
    assert begun_again.ranges_m[180] == pytest.approx(0.43, abs=0.03)
    assert np.isfinite(ring.ranges_m[:90]).all() and not np.isfinite(begun_again.ranges_m[:90]).any()


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0])
def test_floor_between_edges_is_free_where_the_rig_states_its_height_and_nothing_is_elsewhere(height_m: float) -> None:
    ring = Standing(height_m).ring(Panoramas(0, 0, *panoramas(worn, 9.0, plain), SHOWN))
    assert np.isnan(ring.ranges_m).all()
    assert np.median(ring.free_m) > 2.0 if height_m else ring.free_m.max() == 0.0
