"""Dense depth is computed when it is first asked for, and for the pairs that enter the map."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.config import MappingConfig
from omnid.core.odometry.exposure_times import Exposure
from omnid.messages import DensePoints, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.mapping import Mapping
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import wrapped

IMAGE = np.zeros((4, 100), np.uint8)


class Counted:
    """Depth of pairs, and how often it was computed for which."""

    def __init__(self) -> None:
        self.computed: list[int] = []
        self.exposures: list[Exposure | None] = []

    def __call__(self, pair: Panoramas, exposure: Exposure | None) -> DensePoints:
        self.computed.append(pair.seq)
        self.exposures.append(exposure)
        points = np.array([[1.0, 2.0, 0.5]])
        return DensePoints(np.full((4, 100), np.nan, np.float32), np.zeros((1, 2)), points, np.full(1, 1e-4))


def panoramas(seq: int, stamp_ns: int = 0) -> Panoramas:
    panorama = wrapped(IMAGE)
    return Panoramas(seq, stamp_ns, panorama, panorama, IMAGE > 0)


@pytest.mark.parametrize(
    ("rate_hz", "speed_mps", "expected"),
    [
        (5.0, 1.0, 10),  # as often as the rate says, of 30 pairs a second for 2 s
        (0.0, 0.0, 60),  # all
        (5.0, 0.0, 2),  # at rest, once a second
        (1000.0, 0.5, 30),  # as soon as the view has changed by 3 cm, which is every second pair
    ],
)
def test_pairs_enter_the_map_at_its_rate_while_the_robot_moves(rate_hz: float, speed_mps: float, expected: int) -> None:
    counted = Counted()
    mapping = Mapping(MappingConfig(rate_hz=rate_hz), DenseDepths(counted))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([speed_mps * stamp_ns * 1e-9, 0, 0]))
        mapping.process(
            OdometryUpdate(
                seq,
                stamp_ns,
                T,
                np.eye(6),
                np.zeros(6),
                np.eye(6),
                TrackingState.TRACKING,
                0,
                50,
                50,
                StereoDepth(panoramas(seq, stamp_ns)),
            )
        )
    assert len(counted.computed) == expected
    path_xy = mapping.finish()[0].path_xy  # it goes on where no pair enters the map
    np.testing.assert_allclose(path_xy[-1], [speed_mps * 59 / 30, 0], atol=1e-6)


def test_keyframes_enter_the_map_after_half_the_time() -> None:
    """Their dense stereo is computed in any case: with one in time, no other pair needs it."""
    counted = Counted()
    mapping = Mapping(MappingConfig(rate_hz=5.0), DenseDepths(counted))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([stamp_ns * 1e-9, 0, 0]))
        mapping.process(
            OdometryUpdate(
                seq,
                stamp_ns,
                T,
                np.eye(6),
                np.zeros(6),
                np.eye(6),
                TrackingState.TRACKING,
                0,
                50,
                50,
                StereoDepth(panoramas(seq, stamp_ns)),
                is_keyframe=seq % 4 == 0,
            )
        )
    assert counted.computed == list(range(0, 60, 4))


def test_keyframes_alone_enter_a_map_without_readers() -> None:
    """Later readers find it; from then on pairs enter it at its rate."""
    counted, seqs = Counted(), [0]
    mapping = Mapping(MappingConfig(rate_hz=15.0), DenseDepths(counted), 0.5, is_read=lambda: seqs[-1] > 30)
    maps = 0
    for seq in range(60):
        seqs.append(seq)
        stamp_ns = round(seq * 1e9 / 30)
        update = OdometryUpdate(
            seq,
            stamp_ns,
            se3.transform(np.eye(3), np.array([stamp_ns * 1e-9, 0, 0])),
            np.eye(6),
            np.zeros(6),
            np.eye(6),
            TrackingState.TRACKING,
            0,
            50,
            50,
            StereoDepth(panoramas(seq, stamp_ns)),
            is_keyframe=seq % 10 == 0,
        )
        maps += mapping.process(update) is not None
    assert counted.computed == [0, 10, 20, 30, *range(32, 60, 2)]
    assert maps == 3, "a query for the newest one finds it"
