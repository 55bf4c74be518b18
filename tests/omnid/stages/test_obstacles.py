"""The ring of a rendered run: the walls are where they are, and threads give the same bytes as inline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.config import load_config
from omnid.core.obstacles.cell_kernels import SURFACE
from omnid.core.obstacles.grid import CELL_M
from omnid.messages import DensePoints, ObstacleRing, OdometryUpdate, Panoramas, StereoDepth
from omnid.runs.replay import ReplayOptions, run_log
from omnid.simulation.rendering.rigs import make_rig
from omnid.sinks.encoder import Outgoing
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry
from omnid.stages.obstacles import Obstacles
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


class Rings:
    """Rings of a run, and the number of its poses."""

    def __init__(self) -> None:
        self.rings: list[ObstacleRing] = []
        self.poses = 0

    def process(self, message: Outgoing) -> None:
        """Keep a ring."""
        self.poses += isinstance(message, OdometryUpdate)
        if isinstance(message, ObstacleRing):
            self.rings.append(message)


def rings_of(scene: Path, *settings: str, inline: bool = True) -> Rings:
    """Return the rings of the rendered run."""
    found = Rings()
    config = load_config(None, ["places.enabled=false", *settings])
    run_log(
        scene / "log.mcap",
        config,
        ReplayOptions(rig=scene / "rig.toml", inline=inline, observer=lambda geometry, telemetry: found),
    )
    return found


@pytest.fixture(scope="module")
def inline(scene: Path) -> Rings:
    return rings_of(scene)


def test_the_walls_of_the_corridor_stand_left_and_right(inline: Rings) -> None:
    # Left wall between 0.9 and 1.6 m, right wall between 0.8 and 1.4 m from the middle; see corridor().
    ring = inline.rings[len(inline.rings) // 2]
    left, right = ring.ranges_m[260:280], ring.ranges_m[80:100]
    assert np.isfinite(left).any() and np.isfinite(right).any()
    assert 0.6 < np.nanmedian(left) < 2.0 and 0.5 < np.nanmedian(right) < 1.8
    assert np.isfinite(ring.ranges_m).sum() > 150


def test_rings_come_at_the_rate(inline: Rings) -> None:
    # 10 pairs a second.
    assert len(inline.rings) == inline.poses


def test_rings_come_at_a_lower_rate(scene: Path, inline: Rings) -> None:
    assert abs(len(rings_of(scene, "obstacles.rate_hz=5").rings) - len(inline.rings) / 2) <= 1


def test_threads_give_the_same_bytes(scene: Path, inline: Rings) -> None:
    threaded = rings_of(scene, inline=False)
    assert [ring.seq for ring in threaded.rings] == [ring.seq for ring in inline.rings]
    for one, other in zip(threaded.rings, inline.rings, strict=True):
        assert one.ranges_m.tobytes() == other.ranges_m.tobytes()
        assert one.sigma_m.tobytes() == other.sigma_m.tobytes()


def test_off_means_off(scene: Path) -> None:
    assert not rings_of(scene, "obstacles.enabled=false").rings


def stage_at(height_m: float) -> Obstacles:
    """Return the stage of a rig whose cameras are so high over the floor."""
    rig = replace(make_rig(baseline_m=BASELINE_M), T_base_rig=se3.transform(np.eye(3), [0.0, 0.0, height_m]))
    dense = DensePoints(np.full(SHOWN.shape, np.nan, np.float32), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0))
    return Obstacles(Geometry(rig, CYLINDER), load_config().obstacles, DenseDepths(lambda panoramas, exposure: dense))


def at_rest(seq: int, pair: Panoramas, state: TrackingState, resets: int = 0) -> OdometryUpdate:
    """Return what odometry says of a base that stands."""
    of_pose = np.eye(4), np.eye(6), np.zeros(6), np.eye(6)
    return OdometryUpdate(seq, seq * PERIOD_NS, *of_pose, state, resets, 100, 100, StereoDepth(pair))


def test_what_is_known_is_known_again_when_odometry_has_found_its_place_again() -> None:
    """A low thing that was seen from farther away: nothing shows it here, so that it would never be found again."""
    stage = stage_at(HEIGHT_M)
    pairs = [Panoramas(0, 0, *panoramas(stains, 3.0, striped, seed=seed), SHOWN) for seed in range(3)]
    for seq in range(20):
        stage.process(at_rest(seq, pairs[seq % 3], TrackingState.TRACKING))
    grid = stage._rings._grid
    corner = np.round(grid.corner_m / CELL_M).astype(int)
    grid._odds[SURFACE, -corner[1] - 6 : -corner[1] + 6, -corner[0] + 8 : -corner[0] + 11] = 6.0
    ranges_m = []
    for seq, state in ((20, TrackingState.TRACKING), (21, TrackingState.LOST), (22, TrackingState.DEGRADED)):
        ring = stage.process(at_rest(seq, pairs[seq % 3], state))
        assert ring is not None
        ranges_m.append(float(ring.ranges_m[180]))
        if state is TrackingState.LOST:
            assert np.isnan(ring.ranges_m).all() and not ring.free_m.any()
    assert ranges_m == pytest.approx([0.43, np.nan, 0.43], abs=0.03, nan_ok=True)
    begun_again = stage.process(at_rest(23, pairs[0], TrackingState.TRACKING, resets=1))
    assert begun_again is not None and begun_again.ranges_m[180] == pytest.approx(0.43, abs=0.03)
    assert np.isfinite(ring.ranges_m[:90]).all() and not np.isfinite(begun_again.ranges_m[:90]).any()


@pytest.mark.parametrize("height_m", [HEIGHT_M, 0.0])
def test_floor_between_edges_is_free_where_the_rig_states_its_height_and_nothing_is_elsewhere(height_m: float) -> None:
    pair = Panoramas(0, 0, *panoramas(worn, 9.0, plain), SHOWN)
    ring = stage_at(height_m).process(at_rest(0, pair, TrackingState.TRACKING))
    assert ring is not None and np.isnan(ring.ranges_m).all()
    assert np.median(ring.free_m) > 2.0 if height_m else ring.free_m.max() == 0.0
