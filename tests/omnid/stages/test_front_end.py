"""From images of a rendered run to poses and depth: panoramas, features, dense depth, and what is dropped."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from calib.panorama import remap_tables
from calib.rig_file import read_rig
from drivers.frame import CAMERAS, Frame
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.diagnostics.status import RunStatistics
from omnid.engine.graph import Graph, no_op
from omnid.formats.tum import read_tum
from omnid.messages import FramePair, OdometryUpdate
from omnid.runs.files import RunPlaces
from omnid.runs.wiring import Inputs, wire
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Dewarp, Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.conftest import PAIRS
from tests.simulation import build, render_grey
from tests.simulation.disturbances import DisturbedCamera

CONFIG = Config()


@pytest.fixture(scope="module")
def frames(scene: Path) -> list[Frame]:
    return list(LogReader(scene / "log.mcap").frames())


@pytest.fixture(scope="module")
def place(scene: Path) -> Geometry:
    return geometry(read_rig(scene / "rig.toml"), CONFIG.panorama)


@pytest.fixture(scope="module")
def pairs(frames: list[Frame], place: Geometry) -> list[FramePair]:
    return list(filter(None, map(Synchronise(place.rig, CONFIG.pair).process, frames)))


def test_points_project_to_the_pixels_they_were_matched_at() -> None:
    """In a misaligned rig, points project into both images where the remap tables have their pixels."""
    run = build("misaligned", seed=1, size=256, pairs=1)
    rig_geometry = geometry(run.rig, CONFIG.panorama)
    pair = FramePair(0, 0, *(render_grey(run.scene, m, run.poses[0]) for m in (run.rig.lower, run.rig.upper)))
    depth = FrontEnd(rig_geometry, CONFIG).dense.points(Dewarp(rig_geometry, CONFIG.panorama).process(pair))
    column, row = depth.pixels.astype(int).T
    below = row + depth.disparity[row, column]
    assert len(column) > 300
    for mounted, rows in ((run.rig.lower, row), (run.rig.upper, below)):
        seen = mounted.camera.project(se3.apply(mounted.T_cam_rig, depth.points))
        tables = remap_tables(run.rig, mounted, rig_geometry.cylinder)
        expected = np.column_stack(
            [cv2.remap(t, column.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR).ravel() for t in tables]
        )
        assert np.abs(seen - expected).max() < 0.05


def test_a_dim_image_is_brightened_and_its_noise_is_known(place: Geometry, pairs: list[FramePair]) -> None:
    pair = pairs[0]
    dewarp = Dewarp(place, Config().panorama)
    bright = dewarp.process(pair)
    noise = np.random.default_rng(1).normal(0, 5, pair.lower.shape)
    dim = np.clip(np.rint(0.25 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    dark = Dewarp(place, Config().panorama).process(replace(pair, lower=dim))
    assert bright.lower.gain == bright.upper.gain == dark.upper.gain == 1
    np.testing.assert_array_equal(bright.upper.image, dark.upper.image)
    shown, other = (one.panorama[dark.visible].mean() for one in (dark.lower, dark.upper))
    assert dark.lower.gain > 1.5 and abs(shown / other - 1) < 0.1
    both = np.clip(np.rint(0.25 * pair.upper + 5 + noise), 0, 255).astype(np.uint8)
    evening = Dewarp(place, Config().panorama).process(replace(pair, lower=dim, upper=both))
    assert abs(evening.lower.panorama[dark.visible].mean() - 80) < 2
    assert dark.light.level_grey < 50 < bright.light.level_grey
    assert dark.light.contrast_to_noise < 0.4 * bright.light.contrast_to_noise
    assert not dark.light.is_too_dark and not bright.light.is_too_dark
    night = np.clip(np.rint(0.02 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    assert Dewarp(place, Config().panorama).process(replace(pair, lower=night)).light.is_too_dark
    assert 2.0 < dark.lower.noise_grey / dark.lower.gain < 6.0  # interpolation makes it less than 5
    assert bright.lower.noise_grey < 3.0


def test_the_reflection_of_a_lens_in_its_mirror_has_no_depth(
    place: Geometry, pairs: list[FramePair], scene: Path
) -> None:
    """Both panoramas show it at the same pixels, so that stereo puts it far below the floor, which is z = 0."""
    front_end, truth = FrontEnd(place, Config()), read_tum(scene / "truth.txt")
    cameras = place.rig.lower, place.rig.upper
    reflected = [DisturbedCamera.of(["flare"], k, m.visible, m.camera.size, 1) for k, m in enumerate(cameras)]
    below, confirmed = 0, 0
    for pair in pairs:
        lower, upper = (
            np.clip(camera.shown(image.astype(np.float32), 0.0), 0, 255).astype(np.uint8)
            for camera, image in zip(reflected, (pair.lower, pair.upper), strict=True)
        )
        update = front_end.pose(FramePair(pair.seq, pair.stamp_ns, lower, upper))
        if update.depth.earlier is not None and update.is_keyframe:
            T = truth.T[truth.stamps_ns == pair.stamp_ns][0]
            matched = front_end.dense.points(update.depth.panoramas, update.depth.exposure)
            below += int((se3.apply(T, matched.points)[:, 2] < -0.5).sum())
            confirmed += int((se3.apply(T, front_end.dense.of(update.depth).points)[:, 2] < -0.5).sum())
    assert below > 100 and confirmed < 0.4 * below, (below, confirmed)


def test_a_slow_bus_drops_messages_and_delays_no_pose(place: Geometry, frames: list[Frame]) -> None:
    """The bus holds all messages until all poses are there."""
    graph, statistics, complete = Graph(drops=True, depth=1), RunStatistics(), threading.Event()

    class Complete:
        def process(self, message: OdometryUpdate) -> None:
            statistics.process(message)

        def finish(self) -> None:
            complete.set()

    class SlowBus:
        def process(self, message: object) -> None:
            assert complete.wait(60.0), "the poses waited for the bus"

    read = graph.source("read", lambda: frames)
    inputs = Inputs([read], RunPlaces(CONFIG, place, no_op), map_every_s=0.5)
    streams = wire(CONFIG, inputs, FrontEnd(place, CONFIG), graph)
    graph.sink("complete", Complete(), streams.poses, thread=streams.poses.thread)
    streams.publish(graph, SlowBus())
    graph.run()
    assert statistics.poses == graph.stats["odometry"].processed


def test_old_images_of_a_live_run_are_dropped_before_any_work(place: Geometry, frames: list[Frame]) -> None:
    """One thread estimates poses from the newest images: each decoded pair has a pose, however fast images come."""
    graph, statistics = Graph(drops=True, depth=1), RunStatistics()
    stages = FrontEnd(place, CONFIG)
    cameras = {
        name: graph.source(name, lambda name=name: [frame for frame in frames if frame.camera == name])  # type: ignore[misc]
        for name in CAMERAS
    }
    inputs = Inputs(list(cameras.values()), RunPlaces(CONFIG, place, no_op))
    poses = wire(CONFIG, inputs, stages, graph).poses
    graph.sink("statistics", statistics, poses, thread=poses.thread)
    graph.run()
    stats = graph.stats
    assert stats["pair"].dropped > 0 and stats["odometry"].dropped == 0
    assert (
        0
        < statistics.poses
        == stats["dewarp"].processed
        == stats["odometry"].processed
        == stats["odometry completion"].processed
    )
    assert stats["pair"].dropped + stats["pair"].processed == 2 * PAIRS
