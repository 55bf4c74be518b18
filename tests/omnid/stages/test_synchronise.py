"""From frames to pairs: any order of arrival, broken, repeated, unpaired images, cameras that are not synchronised."""

from __future__ import annotations

import random
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnid
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.frame import Camera, Frame, gray
from drivers.logs.log_reader import LogCameras, LogReader
from drivers.motion import GyroSample, WheelSample
from omnid.config import PairConfig
from omnid.messages import FramePair
from omnid.stages.synchronise import MAX_FRAMES, MotionInbox, Skew, Synchronise
from tests.simulation import build, write_log
from tests.simulation.logs import Readout
from tests.simulation.rigs import with_upper_rotated

MS = 1_000_000
PERIOD_NS = 33_333_333
SIZE = 256
JPEG = cv2.imencode(".jpg", np.full((SIZE, SIZE), 90, np.uint8))[1].tobytes()


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build("two_walls", seed=3, size=SIZE, pairs=2).rig


@pytest.fixture
def pair(rig: Rig) -> Synchronise:
    return Synchronise(rig, PairConfig(tolerance_ms=10.0, repeated_images="use"))


def shot(camera: Camera, index: int, skew_ns: int = 0, data: bytes = JPEG) -> Frame:
    return Frame(index, 10**12 + index * PERIOD_NS + skew_ns, camera, "jpeg", data)


def made(pair: Synchronise, *frames: Frame) -> list[FramePair]:
    return [found for frame in frames if (found := pair.process(frame)) is not None]


def unpaired(pair: Synchronise) -> tuple[int, int]:
    return pair.stats()["unpaired_lower"], pair.stats()["unpaired_upper"]


def test_all_frames_are_paired_in_any_order_of_arrival(pair: Synchronise) -> None:
    """Frames of one camera arrive up to three periods later than those of the other."""
    rng, order = random.Random(5), []
    for camera in ("lower", "upper"):
        late = 0.0
        for index in range(200):
            late = max(late - 1.0, rng.uniform(0.0, 3.0))  # of one camera they stay in order
            order.append((index + late, shot(camera, index, rng.randrange(-4 * MS, 4 * MS))))  # type: ignore[arg-type]
    found = made(pair, *(frame for _, frame in sorted(order, key=lambda entry: entry[0])))
    assert [p.seq for p in found] == list(range(200)) and unpaired(pair) == (0, 0)
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(found))


@pytest.mark.parametrize(
    ("order", "stamps", "expected"),
    [
        ([("lower", 0), ("upper", 2), ("upper", 99), ("lower", 100)], [0, 100], (0, 0)),
        ([("lower", 0), ("upper", 10)], [0], (0, 0)),
        ([("lower", 0), ("upper", 11)], [], (1, 1)),
        ([("lower", 0), ("lower", 5), ("upper", 6)], [5], (1, 0)),
        ([("upper", 0), ("upper", 100), ("lower", 101), ("lower", 200)], [101], (1, 1)),
    ],
)
def test_frames_are_paired_in_the_order_of_their_stamps(
    pair: Synchronise, order: list[tuple[Camera, int]], stamps: list[int], expected: tuple[int, int]
) -> None:
    found = made(pair, *(Frame(0, stamp_ms * MS, camera, "jpeg", JPEG) for camera, stamp_ms in order))
    pair.finish()
    assert [p.stamp_ns for p in found] == [stamp_ms * MS for stamp_ms in stamps]
    assert [p.seq for p in found] == list(range(len(stamps))) and unpaired(pair) == expected


def test_pairs_go_on_after_a_camera_was_away(pair: Synchronise) -> None:
    assert len(made(pair, shot("lower", 0), shot("upper", 0))) == 1
    assert made(pair, *(shot("upper", index) for index in range(1, 1000))) == []
    assert sum(unpaired(pair)) >= 999 - MAX_FRAMES, "few frames wait"
    assert pair.newest_ns["lower"] < pair.newest_ns["upper"]
    back = [frame for index in range(1000, 1010) for frame in (shot("lower", index), shot("upper", index))]
    assert len(made(pair, *back)) == 10
    pair.finish()
    assert unpaired(pair) == (0, 999) and pair.stats()["pairs"] == 11


@pytest.mark.parametrize("broken", [("lower",), ("lower", "upper")])
def test_a_broken_image_is_treated_as_if_it_had_never_come(pair: Synchronise, broken: tuple[Camera, ...]) -> None:
    """The frames before a broken one can still be paired."""
    data = {camera: JPEG[:100] if camera in broken else JPEG for camera in ("lower", "upper")}
    early = [shot("lower", 0), shot("lower", 0, 2 * MS, data["lower"])]
    found = made(pair, *early, shot("upper", 0, 3 * MS, data["upper"]), shot("upper", 0, 4 * MS))
    assert len(found) == 1 and pair.stats()["broken"] == len(broken)
    assert found[0].stamp_ns == shot("lower", 0, 0 if "lower" in broken else 2 * MS).stamp_ns


def test_samples_go_along_with_the_pair_that_ends_their_step(pair: Synchronise) -> None:
    """Up to its stamp and one after it; the others wait, and late ones are not lost."""
    start_ns = shot("lower", 0).stamp_ns
    wheels = [WheelSample(start_ns + k * 10 * MS, 0.1 * k, 0.0) for k in (0, 2, 1, 4, 3)]
    gyro = GyroSample(start_ns + 35 * MS, 0.0, 0.0, 0.5)
    assert [pair.process(sample) for sample in (*wheels, gyro)] == [None] * 6
    first, second = made(pair, *(shot(camera, index) for index in range(2) for camera in ("lower", "upper")))
    assert first.motion == (wheels[0], wheels[2], gyro)
    assert second.motion == (wheels[2], wheels[1], wheels[4], gyro, wheels[3])


@pytest.fixture
def free(rig: Rig) -> Synchronise:
    """Cameras that run freely: the default tolerance."""
    return Synchronise(rig, PairConfig(repeated_images="use"))


@pytest.mark.parametrize("skew_ms", [0.0, 15.0, -16.6])
def test_free_running_cameras_make_a_pair_of_every_image(free: Synchronise, skew_ms: float) -> None:
    """Also of the first ones, which wait until the period is known."""
    taken = [shot(c, index, round(skew_ms * MS) * (c == "upper")) for index in range(60) for c in ("lower", "upper")]
    found = made(free, *sorted(taken, key=lambda frame: frame.stamp_ns))
    assert [p.stamp_ns for p in found] == [shot("lower", index).stamp_ns for index in range(60)]
    assert unpaired(free) == (0, 0) and free.stats()["tolerance_ms"] == pytest.approx(PERIOD_NS * 0.5e-6, abs=0.01)
    assert all(p.skew_s == pytest.approx(1e-3 * skew_ms, abs=1e-6) for p in found[10:])


def image(number: int) -> np.ndarray:
    """Return a grey wall with the noise of the frame with this number."""
    noise = np.random.default_rng(number).integers(-2, 3, (SIZE, SIZE))
    return (90 + noise).astype(np.uint8)


def frames(lower: Iterable[int], upper: Iterable[int]) -> list[Frame]:
    def shot(camera: Camera, index: int, number: int) -> Frame:
        return Frame(index, 10**12 + index * PERIOD_NS, camera, "png", cv2.imencode(".png", image(number))[1])

    return [
        frame
        for index, (low, up) in enumerate(zip(lower, upper, strict=True))
        for frame in (shot("lower", index, low), shot("upper", index, up + 10**6))
    ]


@pytest.mark.hazard("H34")
@pytest.mark.parametrize("dead", [("upper",), ("lower", "upper")])
def test_pairs_of_a_frozen_camera_are_left_out(rig: Rig, dead: tuple[Camera, ...]) -> None:
    """The images of the other camera go on; two images after the camera lives again there is a pair again."""
    pairing, living = Synchronise(rig, PairConfig()), list(range(30))
    frozen = [*living[:10], *[9] * 10, *living[20:]]
    shots = frames(*(frozen if camera in dead else living for camera in ("lower", "upper")))
    during = [pairing.process(frame) for frame in shots[:40]]
    assert pairing.stats()["_frozen"] == " and the ".join(dead)
    made = [pair for frame in [*shots[40:]] if (pair := pairing.process(frame)) is not None]
    assert [pair is not None for pair in during[1::2]] == [True] * 10 + [False] * 10 and len(made) == 10
    stats = pairing.stats()
    assert stats["pairs"] == 20 and unpaired(pairing) == (0, 0) and not stats["broken"] and not stats["_frozen"]
    assert all(stats[f"repeated_{camera}"] == 10 * (camera in dead) for camera in ("lower", "upper"))
    assert [pair.seq for pair in made] == list(range(10, 20))


TRIGGERED = random.Random(1)


def jitter(sigma_ms: float, count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(0, sigma_ms, count)


@pytest.mark.parametrize(
    ("skews_ms", "expected_ms", "within_ms"),
    [
        # Cameras that are triggered together are simultaneous however their stamps scatter.
        *(([TRIGGERED.uniform(-2, 2) for _ in range(count)], 0.0, 0.0) for count in (1, 8, 100)),
        # That of free cameras is found below the scatter of the stamps, also where their clocks drift.
        (5 + 0.003 * np.arange(100) + jitter(0.1, 100), 5.3, 0.15),
        # Another one after a lost image counts at once.
        ([14.0] * 40 + [-19.0], -19.0, 0.0),
    ],
)
def test_the_time_between_the_exposures_of_a_pair_is_found(
    skews_ms: Iterable[float], expected_ms: float, within_ms: float
) -> None:
    skew = Skew()
    for value_ms in skews_ms:
        skew.add(round(value_ms * MS))
    assert skew.exposure_ns / MS == pytest.approx(expected_ms, abs=within_ms)


def test_samples_of_another_clock_and_too_many_are_dropped_and_counted() -> None:
    inbox = MotionInbox()
    for k in range(5000):
        inbox.add(WheelSample(k, 0.0, 0.0))
    assert inbox.dropped == 5000 - 4096 and len(inbox.take(10**4)) == 4096
    inbox.add(WheelSample(10**12, 0.0, 0.0))
    assert not inbox.take(10**4) and not inbox.take(10**12)
    assert inbox.dropped == 5000 - 4096 + 1


@pytest.fixture(scope="module")
def skewed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rig]:
    """Write a log of fast driving whose upper images are 25 ms later; return it and its rig."""
    folder = tmp_path_factory.mktemp("skewed")
    run = build("two_walls", seed=32, size=256, pairs=14)
    write_log(
        folder,
        run.rig,
        run.poses,
        run.scene,
        sensor=run.sensor,
        seed=32,
        readout=Readout(speed=2.0, skew_ms=(25.0, 25.0)),
    )
    return folder / "log.mcap", read_rig(folder / "rig.toml")


@pytest.mark.parametrize(("turn_deg", "warned"), [(0.0, False), (0.7, True)])
def test_a_drifted_rig_is_reported_and_motion_is_not(skewed: tuple[Path, Rig], turn_deg: float, warned: bool) -> None:
    log, rig = skewed
    warnings = omnid.replay(log, with_upper_rotated(rig, (0.0, turn_deg, 0.0))).warnings
    assert any("do not quite fit the rig" in text for text in warnings) == warned, warnings


def test_images_with_both_stamps_give_the_poses_of_a_replay(skewed: tuple[Path, Rig]) -> None:
    log, rig = skewed
    expected = omnid.replay(log, rig)
    found = list(LogReader(log, LogCameras(*rig.topics)).frames())
    frames = {name: [frame for frame in found if frame.camera == name] for name in ("lower", "upper")}
    odometry, blind = omnid.Odometry(rig), omnid.Odometry(rig)
    for number, (lower, upper) in enumerate(zip(frames["lower"], frames["upper"], strict=True)):
        images = gray(lower), gray(upper)
        update = odometry.process(lower.stamp_ns, *images, upper_stamp_ns=upper.stamp_ns)
        np.testing.assert_array_equal(update.T_odom_rig, expected.T_odom_rig[number])
        at_once = blind.process(lower.stamp_ns, *images)
    assert not np.array_equal(at_once.T_odom_rig, update.T_odom_rig)
    with pytest.raises(omnid.OmnidError, match="less than 1 s from stamp_ns"):
        odometry.process(lower.stamp_ns + 1, *images, upper_stamp_ns=lower.stamp_ns // 1000)
    with pytest.raises(omnid.OmnidError, match="upper_stamp_ns: expected an integer"):
        odometry.process(lower.stamp_ns + 1, *images, upper_stamp_ns=0.5)  # type: ignore[arg-type]
