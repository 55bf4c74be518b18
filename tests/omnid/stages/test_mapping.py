"""Pairs that enter the map, and the grid that is drawn of it: at their rates, and only what has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.config import Config, MappingConfig
from omnid.core.mapping.scan_grid import KeyframeScans
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.types.panorama import Panoramas
from omnid.messages import DensePoints, OdometryUpdate, PlaceUpdate, StereoDepth
from omnid.stages.geometry import DenseDepths, Geometry, geometry
from omnid.stages.mapping import MapGrid, Mapping
from omnid.tracking_state import MapState, TrackingState
from tests.omnid.core.scenery import wrapped
from tests.simulation import make_rig

CONFIG = Config()
IMAGE = np.zeros((4, 100), np.uint8)
SECOND_NS = 10**9
SCAN = np.full(360, 2.0, np.float16)


@pytest.fixture(scope="module")
def place() -> Geometry:
    return geometry(make_rig(size=768, baseline_m=0.2), CONFIG.panorama)


class CountedDepths(DenseDepths):
    """Depth of pairs, and for which of them it was computed."""

    def __init__(self, place: Geometry) -> None:
        super().__init__(place, CONFIG.stereo)
        self.computed: list[int] = []

    def points(self, panoramas: Panoramas, exposure: Exposure | None = None) -> DensePoints:
        """Return one point."""
        self.computed.append(panoramas.seq)
        points = np.array([[1.0, 2.0, 0.5]])
        return DensePoints(np.full((4, 100), np.nan, np.float32), np.zeros((1, 2)), points, np.full(1, 1e-4))


def driven(mapping: Mapping, speed_mps: float, is_keyframe: Callable[[int], bool]) -> int:
    """Let a map take 30 pairs a second for 2 s; return how many maps it has given."""
    maps = 0
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([speed_mps * stamp_ns * 1e-9, 0, 0]))
        depth = StereoDepth(Panoramas(seq, stamp_ns, wrapped(IMAGE), wrapped(IMAGE), IMAGE > 0))
        of_pose = seq, stamp_ns, T, np.eye(6), np.zeros(6), np.eye(6), TrackingState.TRACKING
        update = OdometryUpdate(*of_pose, 0, 50, 50, depth, is_keyframe=is_keyframe(seq))
        maps += mapping.process(update) is not None
    return maps


@pytest.mark.parametrize(
    ("rate_hz", "speed_mps", "expected"),
    [
        (5.0, 1.0, 10),  # as often as the rate says, of 30 pairs a second for 2 s
        (0.0, 0.0, 60),  # all
        (5.0, 0.0, 2),  # at rest, once a second
        (1000.0, 0.5, 30),  # as soon as the view has changed by 3 cm, which is every second pair
    ],
)
def test_pairs_enter_the_map_at_its_rate_while_the_robot_moves(
    place: Geometry, rate_hz: float, speed_mps: float, expected: int
) -> None:
    dense = CountedDepths(place)
    mapping = Mapping(MappingConfig(rate_hz=rate_hz), dense)
    driven(mapping, speed_mps, lambda _: False)
    assert len(dense.computed) == expected
    path_xy = mapping.finish()[0].path_xy  # it goes on where no pair enters the map
    np.testing.assert_allclose(path_xy[-1], [speed_mps * 59 / 30, 0], atol=1e-6)


def test_keyframes_alone_enter_a_live_map(place: Geometry) -> None:
    dense = CountedDepths(place)
    mapping = Mapping(MappingConfig(rate_hz=15.0), dense, 0.5, keyframes_only=True)
    maps = driven(mapping, 1.0, lambda seq: seq % 10 == 0)
    assert dense.computed == [*range(0, 60, 10)] and maps == 3


def scans(count: int) -> KeyframeScans:
    return KeyframeScans(
        dict.fromkeys(range(count), SCAN), dict.fromkeys(range(count), SCAN), np.tile(np.eye(4), (count, 1, 1))
    )


def grid_update(seq: int, seen: KeyframeScans | None) -> PlaceUpdate:
    return PlaceUpdate(seq, seq * SECOND_NS, np.eye(4), np.eye(4), np.eye(6), MapState.ODOMETRY_ONLY, scans=seen)


def given(stage: MapGrid, updates: list[PlaceUpdate]) -> list[int]:
    return [found.seq for found in map(stage.process, updates) if found is not None]


def test_a_grid_is_drawn_when_it_is_due_and_has_changed() -> None:
    stage, one, two = MapGrid(0.05, np.eye(4), every_s=2.0), scans(1), scans(2)
    assert given(stage, [grid_update(k, one if k < 7 else two) for k in range(1, 8)]) == [2, 7]
    # Nor scans of unknown place: of a saved map, or after a gap, until a place is recognised.
    assert stage.process(replace(grid_update(10, scans(4)), is_known=False)) is None
    assert list(stage.finish()) == []
    assert stage.process(grid_update(8, scans(3))) is None
    [last] = stage.finish()
    assert last.seq == 8 and last.grid.cells.max() == 100
