"""The front end: the same poses in one call or as two stages, and a check of the rig that sees each pair once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.column_finding import PanoramaPair
from omnid.core.rig.rig_health import RigHealth
from omnid.formats.tum import read_tum
from omnid.messages import FramePair, Panoramas
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.simulation.disturbances import DisturbedCamera

PAIRS = 4


@pytest.fixture(scope="module")
def place(scene: Path) -> Geometry:
    return geometry(read_rig(scene / "rig.toml"), Config().panorama)


@pytest.fixture(scope="module")
def pairs(scene: Path, place: Geometry) -> list[FramePair]:
    pairing = Synchronise(place.rig, Config().pair)
    return [pair for pair in map(pairing.process, LogReader(scene / "log.mcap").frames()) if pair][:PAIRS]


class Seen(RigHealth):
    """State of a rig that notes the first pairs, and decides nothing."""

    def __init__(self, place: Geometry) -> None:
        super().__init__(place.cylinder, "warn")
        self.pairs: list[tuple[int, bool]] = []  # number, and whether its motion is given

    def begin(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        assert isinstance(pair, Panoramas)
        self.pairs.append((pair.seq, exposure is not None))


def test_the_rig_is_checked_by_pairs_that_are_not_synchronised_after_odometry_has_found_their_motion(
    place: Geometry, pairs: list[FramePair]
) -> None:
    at_once, skewed = Seen(place), Seen(place)
    for health, skew_s in ((at_once, 0.0), (skewed, 0.015)):
        front_end = FrontEnd(place, Config(), health)
        for number, pair in enumerate(pairs):
            front_end.process(FramePair(number, pair.stamp_ns, pair.lower, pair.upper, skew_s))
    assert at_once.pairs == [(number, False) for number in range(PAIRS)]
    assert [number for number, _ in skewed.pairs] == list(range(PAIRS - 1))
    assert all(is_given for number, is_given in skewed.pairs if number > 0)


def test_the_stereo_of_the_papers_method_is_chosen_for_all(place: Geometry, pairs: list[FramePair]) -> None:
    """The method of the odometry decides the matching that each user of the front end gets."""
    paper = Config(odometry=Config().odometry.__class__(method="paper"))
    found = [FrontEnd(place, config).dense for config in (Config(), paper)]
    panoramas = FrontEnd(place, Config()).dewarp.process(pairs[0])
    disparities = [np.nan_to_num(dense.points(panoramas).disparity) for dense in found]
    assert not np.array_equal(*disparities)


def test_the_reflection_of_a_lens_in_its_mirror_has_no_depth(place: Geometry, scene: Path) -> None:
    """Both panoramas show it at the same pixels, so that stereo puts it far below the floor, which is z = 0."""
    front_end, truth = FrontEnd(place, Config()), read_tum(scene / "truth.txt")
    cameras = place.rig.lower, place.rig.upper
    reflected = [DisturbedCamera.of(["flare"], k, m.visible, m.camera.size, 1) for k, m in enumerate(cameras)]
    pairing = Synchronise(place.rig, Config().pair)
    below, confirmed = 0, 0
    for pair in filter(None, map(pairing.process, LogReader(scene / "log.mcap").frames())):
        lower, upper = (
            np.clip(camera.shown(image.astype(np.float32), pair.seq, 0.0), 0, 255).astype(np.uint8)
            for camera, image in zip(reflected, (pair.lower, pair.upper), strict=True)
        )
        update = front_end.process(FramePair(pair.seq, pair.stamp_ns, lower, upper))
        if update.depth.earlier is not None and update.is_keyframe:
            T = truth.T[truth.stamps_ns == pair.stamp_ns][0]
            matched = front_end.dense.points(update.depth.panoramas, update.depth.exposure)
            below += int((se3.apply(T, matched.points)[:, 2] < -0.5).sum())
            confirmed += int((se3.apply(T, front_end.dense.of(update.depth).points)[:, 2] < -0.5).sum())
    assert below > 100 and confirmed < 0.4 * below, (below, confirmed)
