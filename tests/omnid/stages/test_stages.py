"""The stages one by one, on real frames of a rendered run."""

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
from drivers.frame import Camera, Frame
from drivers.logs.log_reader import LogReader
from omnid.camera_config import PairConfig
from omnid.config import Config, MappingConfig
from omnid.core.frames import in_outer_axes, of_base
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.engine.graph import Graph, Stream
from omnid.engine.playback_clock import PlaybackClock
from omnid.formats.tum import read_tum
from omnid.messages import DensePoints, FramePair, MapUpdate, OdometryUpdate, StereoDepth
from omnid.runs.pipeline import RunParts, Sinks, wire
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.mapping import Mapping
from omnid.stages.synchronise import Synchronise
from tests.conftest import PAIRS
from tests.simulation import build, make_rig, render_grey

CONFIG = Config()
MS = 1_000_000


@pytest.fixture(scope="module")
def frames(scene: Path) -> list[Frame]:
    return list(LogReader(scene / "log.mcap").frames())


@pytest.fixture(scope="module")
def rig_geometry(scene: Path) -> Geometry:
    return geometry(read_rig(scene / "rig.toml"), CONFIG.panorama)


def stamped(frames: list[Frame], *order: tuple[Camera, int]) -> list[Frame]:
    """Return frames of these cameras with these stamps [ms]."""
    first = {frame.camera: frame for frame in reversed(frames)}
    return [replace(first[camera], stamp_ns=stamp * MS) for camera, stamp in order]


def run_pairs(rig_geometry: Geometry, frames: list[Frame]) -> tuple[list[FramePair], dict[str, int]]:
    sync = Synchronise(rig_geometry.rig, PairConfig())
    made = [pair for frame in frames if (pair := sync.process(frame)) is not None]
    sync.finish()
    return made, sync.counts


def test_a_pair_has_the_image_of_each_camera(rig_geometry: Geometry, frames: list[Frame]) -> None:
    (pair,), _ = run_pairs(rig_geometry, stamped(frames, ("upper", 0), ("lower", 1)))
    (other,), _ = run_pairs(rig_geometry, stamped(frames, ("lower", 0), ("upper", 1)))
    assert np.array_equal(pair.lower, other.lower) and np.array_equal(pair.upper, other.upper)
    assert not np.array_equal(pair.lower, pair.upper)


def test_panoramas_are_scaled_but_not_their_elevations() -> None:
    rig = make_rig(size=768, baseline_m=0.2)
    full, half = (geometry(rig, replace(CONFIG.panorama, scale=scale)).cylinder for scale in (1.0, 0.5))
    assert half.width == pytest.approx(full.width / 2, abs=8)
    assert half.height == pytest.approx(full.height / 2, rel=0.02)
    assert half.row0 / half.focal_px == pytest.approx(full.row0 / full.focal_px, abs=0.01)
    assert geometry(rig, replace(CONFIG.panorama, width_px=800, scale=0.5)).cylinder.width == 800


def front_end(rig_geometry: Geometry) -> FrontEnd:
    return FrontEnd(rig_geometry, CONFIG)


def depth_of(rig_geometry: Geometry, frames: list[Frame]) -> StereoDepth:
    (pair,), _ = run_pairs(rig_geometry, frames[:2])
    return StereoDepth(Dewarp(rig_geometry, CONFIG.panorama).process(pair))


def points_of(rig_geometry: Geometry, frames: list[Frame]) -> DensePoints:
    return front_end(rig_geometry).dense.of(depth_of(rig_geometry, frames))


def test_points_lie_on_the_surfaces_of_the_world(scene: Path, rig_geometry: Geometry, frames: list[Frame]) -> None:
    """The floor of the rendered corridor is z = 0: no points may lie below it."""
    depth = points_of(rig_geometry, frames)
    points = se3.apply(read_tum(scene / "truth.txt").T[0], depth.points)
    sure = depth.variance_m2 < 0.05**2
    assert sure.sum() > 500
    assert np.quantile(points[sure, 2], 0.02) > -0.1
    assert len(depth.points) == len(depth.pixels) == len(depth.variance_m2)
    assert np.isfinite(depth.disparity).sum() >= len(depth.points)


def test_points_project_to_the_pixels_they_were_matched_at() -> None:
    """In a misaligned rig, points project into both images where the remap tables have their pixels."""
    run = build("misaligned", seed=1, size=256, pairs=1)
    rig_geometry = geometry(run.rig, CONFIG.panorama)
    pair = FramePair(0, 0, *(render_grey(run.scene, m, run.poses[0]) for m in (run.rig.lower, run.rig.upper)))
    depth = front_end(rig_geometry).dense.points(Dewarp(rig_geometry, CONFIG.panorama).process(pair))
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


def test_the_visible_region_has_a_margin(rig_geometry: Geometry, frames: list[Frame]) -> None:
    margin = CONFIG.panorama.margin_px
    visible = depth_of(rig_geometry, frames).panoramas.visible
    assert not visible[: margin + 1].any() and not visible[-margin - 1 :].any() and visible.any()
    none, wide = (Dewarp(rig_geometry, replace(CONFIG.panorama, margin_px=m)) for m in (0, 20))
    (pair,), _ = run_pairs(rig_geometry, frames[:2])
    shares = [dewarp.process(pair).visible.mean() for dewarp in (none, wide)]
    assert shares[0] > visible.mean() > shares[1]


def test_a_dim_image_is_brightened_and_its_noise_is_known(rig_geometry: Geometry, frames: list[Frame]) -> None:
    pair = run_pairs(rig_geometry, frames)[0][0]
    dewarp = Dewarp(rig_geometry, Config().panorama)
    bright = dewarp.process(pair)
    noise = np.random.default_rng(1).normal(0, 5, pair.lower.shape)
    dim = np.clip(np.rint(0.25 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    dark = Dewarp(rig_geometry, Config().panorama).process(replace(pair, lower=dim))
    assert bright.lower.gain == bright.upper.gain == dark.upper.gain == 1
    np.testing.assert_array_equal(bright.upper.image, dark.upper.image)
    shown = dark.lower.panorama[dark.visible]
    assert dark.lower.gain > 1.5 and abs(shown.mean() - 80) < 2
    assert dark.light.level_grey < 50 < bright.light.level_grey
    assert dark.light.contrast_to_noise < 0.4 * bright.light.contrast_to_noise
    assert not dark.light.is_too_dark and not bright.light.is_too_dark
    night = np.clip(np.rint(0.02 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    assert Dewarp(rig_geometry, Config().panorama).process(replace(pair, lower=night)).light.is_too_dark
    assert 2.0 < dark.lower.noise_grey / dark.lower.gain < 6.0  # interpolation makes it less than 5
    assert bright.lower.noise_grey < 3.0


def test_a_coarser_panorama_is_made_of_a_blurred_image(rig_geometry: Geometry) -> None:
    """Single pixels of noise are averaged, not picked."""
    size = rig_geometry.rig.lower.camera.size[::-1]
    image = np.random.default_rng(3).integers(100, 200, size).astype(np.uint8)
    pair, spread = FramePair(0, 0, image, image), []
    for config in (CONFIG.panorama, replace(CONFIG.panorama, scale=0.5)):
        seen = Dewarp(geometry(rig_geometry.rig, config), config).process(pair)
        spread.append(seen.lower.panorama[seen.visible].std())
    assert spread[1] < 0.75 * spread[0]


def test_the_variance_of_a_point_follows_from_its_disparity(rig_geometry: Geometry, frames: list[Frame]) -> None:
    """Half a pixel of disparity moves a point by about its standard deviation."""
    depth = points_of(rig_geometry, frames)
    rect = se3.apply(rig_geometry.rig.T_rect_rig, depth.points)
    range_m = np.linalg.norm(rect, axis=1)
    disparity = rig_geometry.cylinder.focal_px * rig_geometry.rig.baseline_m / np.hypot(rect[:, 0], rect[:, 1])
    moved = range_m * CONFIG.stereo.noise_px / disparity
    np.testing.assert_allclose(np.sqrt(depth.variance_m2), moved, rtol=0.01)


def odometry(
    T: np.ndarray,
    *,
    state: str = "tracking",
    covariance: np.ndarray | None = None,
    seq: int = 0,
    depth: StereoDepth | None = None,
) -> OdometryUpdate:
    zero = np.zeros((6, 6))
    cov = zero if covariance is None else covariance
    velocity = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
    return OdometryUpdate(seq, seq * 100 * MS, T, cov, velocity, zero, state, 0, 0, 0, depth)  # type: ignore[arg-type]


def test_covariance_of_the_base_equals_the_scatter_of_its_motions() -> None:
    """Random small motions of the rig, transformed to the base, scatter by the covariance of the base."""
    rng = np.random.default_rng(0)
    T_odom_rig, T_base_rig = se3.exp(rng.normal(0, 1, 6)), se3.exp(rng.normal(0, 1, 6))
    root = rng.normal(0, 1e-4, (6, 6))
    T_odom_base, of_body, velocity, _ = of_base(odometry(T_odom_rig, covariance=root @ root.T), T_base_rig)
    covariance = in_outer_axes(T_odom_base, of_body)
    small = se3.exp(rng.normal(0, 1, (100_000, 6)) @ root.T)
    moved = T_base_rig @ (T_odom_rig @ small) @ se3.inverse(T_base_rig)
    shift = moved[:, :3, 3] - T_odom_base[:3, 3]
    turn = se3.rotation_log(moved[:, :3, :3] @ T_odom_base[:3, :3].T)
    spread = np.cov(np.hstack([shift, turn]).T)
    assert np.abs(spread - covariance).max() < 0.03 * np.abs(covariance).max()
    ahead = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]) * 1e-6)
    base_moved = T_base_rig @ ahead @ se3.inverse(T_base_rig)
    np.testing.assert_allclose(se3.log(base_moved) / 1e-6, velocity, rtol=1e-4)


def test_base_starts_at_the_origin() -> None:
    T_base_rig = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(of_base(odometry(np.eye(4)), T_base_rig)[0], np.eye(4), atol=1e-12)


def test_maps_certain_points_at_tracked_poses_only(rig_geometry: Geometry, frames: list[Frame]) -> None:
    depth, dense = depth_of(rig_geometry, frames), front_end(rig_geometry).dense
    for state, kept in (("tracking", True), ("degraded", False), ("lost", False)):
        mapping = Mapping(MappingConfig(min_frames=1), dense)
        mapping.process(odometry(np.eye(4), state=state, depth=depth))
        (update,) = mapping.finish()
        assert (len(update.points.xyz) > 0) == kept and len(update.path_xy) == 1
    strict = Mapping(MappingConfig(min_frames=1, max_sigma_m=0.001), dense)
    strict.process(odometry(np.eye(4), depth=depth))
    assert len(strict.finish()[0].points.xyz) == 0
    assert Mapping(MappingConfig(), dense).finish() == []


def test_a_full_map_counts_evicted_voxels(rig_geometry: Geometry, frames: list[Frame]) -> None:
    depth, dense = depth_of(rig_geometry, frames), front_end(rig_geometry).dense
    for log2_voxels, evicts in ((18, False), (10, True)):
        mapping = Mapping(MappingConfig(voxel_m=0.01, log2_voxels=log2_voxels, max_sigma_m=10.0), dense)
        for seq in range(3):
            mapping.process(odometry(np.eye(4), depth=depth, seq=seq))
        assert (mapping.counts["evicted"] > 0) == evicts
        assert 0 < mapping.counts["voxels"] <= 0.7 * 2**log2_voxels + len(dense.of(depth).points)


def test_playback_waits_for_the_stamps_until_woken(frames: list[Frame]) -> None:
    frames_an_hour_apart = stamped(frames, ("lower", 0), ("lower", 3_600_000))
    clock = PlaybackClock()
    waiting = clock.messages(frames_an_hour_apart)
    assert next(waiting) is frames_an_hour_apart[0]
    clock.wake()
    assert next(waiting) is frames_an_hour_apart[1]


def paired(graph: Graph, rig_geometry: Geometry, frames: list[Frame]) -> tuple[Synchronise, Stream[FramePair]]:
    pair = Synchronise(rig_geometry.rig, CONFIG.pair)
    return pair, graph.stage("pair", pair, graph.source("read", lambda: frames))


def test_a_slow_bus_drops_messages_and_delays_no_pose(rig_geometry: Geometry, frames: list[Frame]) -> None:
    drops = dropped(rig_geometry, frames, object)
    assert drops["bus"] > PAIRS // 2 and drops["bus-drive"] > PAIRS // 2
    inboxes = ("bus", "bus-drive", "bus-map", "bus-places", "bus-grid", "bus-scan")
    assert sum(drops.values()) == sum(drops[name] for name in inboxes)


def test_a_slow_map_drops_no_pose(rig_geometry: Geometry, frames: list[Frame]) -> None:
    """Maps have their own inbox; a busy machine may still cost a pose or two."""
    assert dropped(rig_geometry, frames, MapUpdate)["bus"] <= 2


def dropped(rig_geometry: Geometry, frames: list[Frame], slow: type) -> dict[str, int]:
    """Return the messages dropped by each stage, with a bus that holds messages of a type until all poses are there."""
    graph, statistics, complete = Graph(), RunStatistics(), threading.Event()

    class Complete:
        def process(self, message: OdometryUpdate) -> None:
            if message.seq == PAIRS - 1:
                complete.set()

    class SlowBus:
        def process(self, message: object) -> None:
            if isinstance(message, slow):
                assert complete.wait(60.0), "the poses waited for the bus"

    sinks = Sinks({"statistics": statistics, "complete": Complete()}, bus=SlowBus())
    wire(
        graph, paired(graph, rig_geometry, frames)[1], front_end(rig_geometry), CONFIG, sinks, RunParts(map_every_s=0.5)
    )
    graph.run()
    assert statistics.poses == PAIRS
    return {stage.name: stage.dropped for stage in graph.telemetry.stages}
