"""Dense depth is computed when it is first read, and for the pairs that enter the map."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.config import MappingConfig
from omnid.core.odometry.exposure_times import Exposure, ExposureTimes, RigVelocity
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.engine.flow import Chain
from omnid.engine.graph import Graph
from omnid.messages import DensePoints, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.mapping import Mapping
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import wrapped

MS = 1_000_000
IMAGE = np.zeros((4, 100), np.uint8)


class Counted:
    """Depth of pairs, and how often it was computed for which."""

    def __init__(self) -> None:
        self.computed: list[int] = []
        self.exposures: list[Exposure | None] = []

    def __call__(self, panoramas: Panoramas, exposure: Exposure | None) -> DensePoints:
        self.computed.append(panoramas.seq)
        self.exposures.append(exposure)
        points = np.array([[1.0, 2.0, 0.5]])
        return DensePoints(np.full((4, 100), np.nan, np.float32), np.zeros((1, 2)), points, np.full(1, 1e-4))

    def depth(self, seq: int, stamp_ns: int) -> StereoDepth:
        panorama = wrapped(IMAGE)
        return StereoDepth(Panoramas(seq, stamp_ns, panorama, panorama, IMAGE > 0), self)


def test_depth_is_computed_once_and_only_where_it_is_read() -> None:
    counted = Counted()
    depth = counted.depth(3, 5 * MS)
    assert (depth.seq, depth.stamp_ns, depth.panoramas.seq) == (3, 5 * MS, 3) and counted.computed == []
    assert len(depth.points) == len(depth.pixels) == len(depth.variance_m2) == 1 and depth.disparity.shape == (4, 100)
    assert counted.computed == [3]


def test_two_threads_that_read_at_the_same_time_compute_the_depth_once() -> None:
    counted, begun = Counted(), threading.Barrier(2, timeout=20)

    def slow(panoramas: Panoramas, exposure: Exposure | None) -> DensePoints:
        time.sleep(0.1)
        return counted(panoramas, exposure)

    panorama = wrapped(IMAGE)
    depth = StereoDepth(Panoramas(3, 0, panorama, panorama, IMAGE > 0), slow)
    found: list[DensePoints] = []

    def read() -> None:
        begun.wait()
        found.append(depth.dense())

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join(20)
    assert counted.computed == [3] and found[0] is found[1]


@pytest.mark.parametrize(("rate_hz", "speed_mps", "expected"), [
    (5.0, 1.0, 10),  # as often as the rate says, of 30 pairs a second for 2 s
    (0.0, 0.0, 60),  # all
    (5.0, 0.0, 2),  # at rest, once a second
    (1000.0, 0.5, 30),  # as soon as the view has changed by 3 cm, which is every second pair
])
def test_pairs_enter_the_map_at_its_rate_while_the_robot_moves(rate_hz: float, speed_mps: float, expected: int
                                                               ) -> None:
    counted, mapping = Counted(), Mapping(MappingConfig(rate_hz=rate_hz))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([speed_mps * stamp_ns * 1e-9, 0, 0]))
        mapping.process(OdometryUpdate(seq, stamp_ns, T, np.eye(6), np.zeros(6), np.eye(6), TrackingState.TRACKING, 0,
                                       50, 50, counted.depth(seq, stamp_ns)))
    assert len(counted.computed) == expected
    assert len(mapping.finish()[0].path_xy) == 61  # the path has every pose


def test_keyframes_enter_the_map_after_half_the_time() -> None:
    """Their dense stereo is computed in any case: with one in time, no other pair needs it."""
    counted, mapping = Counted(), Mapping(MappingConfig(rate_hz=5.0))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([stamp_ns * 1e-9, 0, 0]))
        mapping.process(OdometryUpdate(seq, stamp_ns, T, np.eye(6), np.zeros(6), np.eye(6), TrackingState.TRACKING, 0,
                                       50, 50, counted.depth(seq, stamp_ns), is_keyframe=seq % 4 == 0))
    assert counted.computed == list(range(0, 60, 4))


class Half:
    """Passes on half of an even number."""

    def process(self, number: int) -> int | None:
        return None if number % 2 else number // 2


def test_a_chain_passes_results_on_and_nothing_without_one() -> None:
    chain = Chain(Half(), Half())
    assert [chain.process(number) for number in (8, 6, 5)] == [2, None, None]


class Late:
    """Notes in a list when it takes a message and when it does what is left."""

    def __init__(self, name: str, events: list[str]) -> None:
        self._name, self._events = name, events

    def process(self, number: int) -> int:
        self._events.append(f"{self._name} {number}")
        return number

    def after(self) -> None:
        self._events.append(f"after {self._name}")


def test_a_chain_does_what_is_left_of_both_stages_after_the_result_was_passed_on() -> None:
    events: list[str] = []
    graph = Graph(threaded=False)
    read = graph.source("read", lambda: [1, 2])
    graph.sink("sink", Late("sink", events), graph.stage("stage", Chain(Late("first", events), Late("second", events)),
                                                         read))
    graph.run()
    once = ["first {0}", "second {0}", "sink {0}", "after sink", "after first", "after second"]
    assert events == [event.format(number) for number in (1, 2) for event in once]
    assert graph.telemetry.of("stage").processed == 2


def test_depth_follows_the_motion_until_it_is_settled() -> None:
    counted = Counted()
    depth = counted.depth(3, 5 * MS)
    model = StereoModel(Cylinder(100, 4, 2.0), 0.2)
    slow, fast = (Exposure(ExposureTimes(0.015), RigVelocity(v * np.ones(6), np.eye(6)), model) for v in (0.0, 1.0))
    depth.disparity_at(slow)
    depth.disparity_at(fast)
    assert counted.exposures == [slow, fast]
    depth.settle(slow)
    assert len(depth.points) == 1 and counted.exposures == [slow, fast], "it was computed, and stays"
    depth.disparity_at(slow)  # for the odometry alone
    assert counted.exposures == [slow, fast, slow]
    unread = counted.depth(4, 6 * MS)
    unread.settle(fast)
    assert len(unread.points) == 1 and counted.exposures[-1] is fast
    unread.disparity_at(fast)  # that of a keyframe, which is made after the pose was passed on
    assert len(counted.exposures) == 4
    unread.settle(slow, again=True)
    assert len(unread.points) == 1 and counted.exposures[-1] is slow
