"""Dense depth of a pair, which is computed when it is first asked for, and for the pairs that enter the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.config import Config, MappingConfig
from omnid.core.odometry.exposure_times import Exposure
from omnid.messages import DensePoints, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.mapping import Mapping
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import texture, wrapped
from tests.simulation import make_rig

CONFIG = Config()
IMAGE = np.zeros((4, 100), np.uint8)


@pytest.fixture(scope="module")
def place() -> Geometry:
    return geometry(make_rig(size=768, baseline_m=0.2), CONFIG.panorama)


@pytest.mark.parametrize(("min_range_m", "found"), [(0.5, True), (3.0, False)])
def test_the_search_reaches_the_nearest_points(place: Geometry, min_range_m: float, found: bool) -> None:
    """A wall whose disparity is 60 px stands 0.6 m away."""
    shape = (place.cylinder.height, place.cylinder.width)
    lower = texture(1, shape, sigma_px=3)
    upper = np.roll(lower, 60, axis=0)
    inner = np.zeros(shape, bool)
    inner[10:-80] = True
    dense = DenseDepths(place, replace(CONFIG.stereo, min_range_m=min_range_m))
    depth = dense.points(Panoramas(0, 0, wrapped(lower), wrapped(upper), inner))
    assert ((np.abs(depth.disparity - 60) < 1).sum() > 5000) == found


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
        if seq == 31:
            mapping.process(True)
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


def test_keyframes_enter_the_map_after_half_the_time(place: Geometry) -> None:
    """Their dense stereo is computed in any case: with one in time, no other pair needs it."""
    dense = CountedDepths(place)
    driven(Mapping(MappingConfig(rate_hz=5.0), dense), 1.0, lambda seq: seq % 4 == 0)
    assert dense.computed == list(range(0, 60, 4))


def test_keyframes_alone_enter_a_map_without_readers(place: Geometry) -> None:
    """Later readers find it; from then on pairs enter it at its rate."""
    dense = CountedDepths(place)
    mapping = Mapping(MappingConfig(rate_hz=15.0), dense, 0.5)
    mapping.process(False)
    maps = driven(mapping, 1.0, lambda seq: seq % 10 == 0)
    assert dense.computed == [0, 10, 20, 30, *range(32, 60, 2)]
    assert maps == 3, "a query for the newest one finds it"
