"""Two cameras that run freely: what finds its partner, what does not, and how far their stamps are apart."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import cv2
import numpy as np
import pytest

from calib.rig import Rig
from drivers.frame import Camera, Frame
from omnid.config import PairConfig
from omnid.messages import FramePair
from omnid.stages.live_pairing import WAITING, LivePair
from tests.simulation import build

MS = 1_000_000
PERIOD_NS = 33_333_333
SIZE = 256
JPEG = cv2.imencode(".jpg", np.full((SIZE, SIZE), 90, np.uint8))[1].tobytes()


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build("two_walls", seed=3, size=SIZE, pairs=2).rig


@pytest.fixture
def pair(rig: Rig) -> LivePair:
    return LivePair(rig, PairConfig(tolerance_ms=10.0))


def shot(camera: Camera, index: int, skew_ns: int = 0, data: bytes = JPEG) -> Frame:
    return Frame(index, 10**12 + index * PERIOD_NS + skew_ns, camera, "jpeg", data)


def made(pair: LivePair, *frames: Frame) -> list[FramePair]:
    return [found for frame in frames if (found := pair.process(frame)) is not None]


def unpaired(pair: LivePair) -> tuple[int, int]:
    return pair.counts["unpaired_lower"], pair.counts["unpaired_upper"]


def test_a_pair_has_the_lower_stamp_and_both_images(pair: LivePair) -> None:
    dark = cv2.imencode(".jpg", np.zeros((SIZE, SIZE), np.uint8))[1].tobytes()
    for index, order in enumerate((("lower", "upper"), ("upper", "lower"))):
        (found,) = made(pair, *(shot(c, index, 3 * MS * (c == "upper"), dark if c == "upper" else JPEG)
                                for c in order))  # type: ignore[arg-type]
        assert (found.seq, found.stamp_ns) == (index, shot("lower", index).stamp_ns)
        assert found.lower.mean() > 80 and found.upper.mean() < 5


def test_every_frame_in_any_order_of_arrival_finds_its_partner(pair: LivePair) -> None:
    """One camera's frames come up to three periods later than the other's."""
    rng, order = random.Random(5), []
    for camera in ("lower", "upper"):
        late = 0.0
        for index in range(200):
            late = max(late - 1.0, rng.uniform(0.0, 3.0))  # of one camera they stay in order
            order.append((index + late, shot(camera, index, rng.randrange(-4 * MS, 4 * MS))))  # type: ignore[arg-type]
    found = made(pair, *(frame for _, frame in sorted(order, key=lambda entry: entry[0])))
    assert [p.seq for p in found] == list(range(200)) and unpaired(pair) == (0, 0)
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(found))


def test_the_nearest_of_several_is_taken_and_the_older_ones_are_counted(pair: LivePair) -> None:
    near = [shot("upper", 0, skew) for skew in (-9 * MS, -2 * MS, 8 * MS)]
    assert made(pair, *near) == []
    (found,) = made(pair, shot("lower", 0))
    assert found is not None and pair.skew.mean_ns == -2 * MS
    assert unpaired(pair) == (0, 1), "the one before is no use any more, the one after may still be"
    assert len(made(pair, shot("lower", 0, 9 * MS))) == 1


@pytest.mark.parametrize(("skew_ns", "pairs"), [(10 * MS, 1), (10 * MS + 1, 0), (-10 * MS, 1), (-10 * MS - 1, 0)])
def test_tolerance(pair: LivePair, skew_ns: int, pairs: int) -> None:
    assert len(made(pair, shot("lower", 1), shot("upper", 1, skew_ns))) == pairs
    pair.finish()
    assert unpaired(pair) == (1 - pairs, 1 - pairs)


@pytest.mark.parametrize(("here", "gone"), [("lower", "upper"), ("upper", "lower")])
def test_one_camera_gone_and_back(pair: LivePair, here: Camera, gone: Camera) -> None:
    for index in range(10):
        made(pair, shot("lower", index), shot("upper", index))
    assert made(pair, *(shot(here, index) for index in range(10, 1000))) == []
    assert sum(map(len, pair._waiting.values())) <= WAITING, "what waits is bounded"
    assert pair.newest_ns[gone] < pair.newest_ns[here]
    back = [frame for index in range(1000, 1010) for frame in (shot("lower", index), shot("upper", index))]
    assert len(made(pair, *back)) == 10
    pair.finish()
    assert unpaired(pair) == ((990, 0) if here == "lower" else (0, 990)) and pair.counts["pairs"] == 20


def test_nothing_of_nothing_is_kept_without_a_bound(pair: LivePair) -> None:
    """Cameras that are never in step: no pairs, all counted, a handful waits."""
    for index in range(500):
        assert made(pair, shot("lower", index), shot("upper", index, PERIOD_NS // 2)) == []
    assert sum(map(len, pair._waiting.values())) <= 2 * WAITING
    pair.finish()
    assert unpaired(pair) == (500, 500)


def test_broken_images_cost_their_pair_only(pair: LivePair) -> None:
    frames = [frame for index in range(6) for frame in
              (shot("lower", index, data=JPEG[:100] if index % 2 else JPEG), shot("upper", index))]
    assert [p.seq for p in made(pair, *frames)] == [0, 1, 2]
    assert pair.counts["broken"] == 3 and "lower frame 1" in pair.fault and unpaired(pair) == (0, 0)


def test_only_what_finds_a_partner_is_decoded(pair: LivePair) -> None:
    made(pair, *(shot("lower", index, data=b"no image") for index in range(20)))
    assert pair.counts["broken"] == 0


def test_skew_statistics(pair: LivePair) -> None:
    skews = [1 * MS, 3 * MS, -5 * MS]
    for index, skew_ns in enumerate(skews):
        made(pair, shot("lower", index), shot("upper", index, skew_ns))
    assert pair.skew.mean_ns == pytest.approx(sum(skews) / 3) and pair.skew.most_ns == 5 * MS
    assert math.isnan(pair.skew.wandered_ns), "too early to tell"


@pytest.mark.parametrize("drift_ns", [0, 20_000, -20_000])
def test_cameras_that_drift_apart_are_found(pair: LivePair, drift_ns: int) -> None:
    """20 us a image: 6 ms within 300 images."""
    rng = random.Random(7)
    for index in range(300):
        noise_ns = rng.randrange(-MS, MS)
        made(pair, shot("lower", index), shot("upper", index, index * drift_ns + noise_ns))
    expected_ns = drift_ns * (300 - 50 - 25)  # the slow mean lags by 50 images, the first one by 25
    assert pair.skew.wandered_ns == pytest.approx(expected_ns, abs=0.6 * MS)
