"""The stages one by one, on real frames of a rendered run."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from drivers.frame import CAMERAS, Camera, Frame
from omnid.core.navigation.requests import NavigationCommand, TaughtRoute
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.graph import NEWEST, Graph
from omnid.formats.tum import read_tum
from omnid.messages import DensePoints, MapUpdate, OdometryUpdate, SaveMap
from omnid.runs.wiring import Outputs, Parts, wire
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.places import Places
from tests.conftest import PAIRS
from tests.omnid.stages.scene_parts import CONFIG, depth_of, front_end, run_pairs
from tests.simulation import make_rig

MS = 1_000_000


def stamped(frames: list[Frame], *order: tuple[Camera, int]) -> list[Frame]:
    """Return frames of these cameras with these stamps [ms]."""
    first = {frame.camera: frame for frame in reversed(frames)}
    return [replace(first[camera], stamp_ns=stamp * MS) for camera, stamp in order]


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


def test_the_variance_of_a_point_follows_from_its_disparity(rig_geometry: Geometry, frames: list[Frame]) -> None:
    """Half a pixel of disparity moves a point by about its standard deviation."""
    depth = points_of(rig_geometry, frames)
    rect = se3.apply(rig_geometry.rig.T_rect_rig, depth.points)
    range_m = np.linalg.norm(rect, axis=1)
    disparity = rig_geometry.cylinder.focal_px * rig_geometry.rig.baseline_m / np.hypot(rect[:, 0], rect[:, 1])
    moved = range_m * CONFIG.stereo.noise_px / disparity
    np.testing.assert_allclose(np.sqrt(depth.variance_m2), moved, rtol=0.01)


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

    outputs = Outputs(poses={"statistics": statistics, "complete": Complete()}, bus=SlowBus())
    read = graph.source("read", lambda: frames)
    wire(graph, [read], front_end(rig_geometry), CONFIG, outputs, Parts(map_every_s=0.5))
    graph.run()
    assert statistics.poses == PAIRS
    return {stage.name: stage.dropped for stage in graph.telemetry.stages}


def test_the_map_is_copied_for_a_route_that_was_written_and_for_requests(
    rig_geometry: Geometry, frames: list[Frame]
) -> None:
    stages, route = front_end(rig_geometry), Any
    places = Places(rig_geometry, CONFIG, stages.dense)
    poses = [stages.process(pair) for pair in run_pairs(rig_geometry, frames[:8])[0]]
    failed = NavigationCommand(TaughtRoute(route, 7), 0, refusal="the disk is full")  # type: ignore[arg-type]
    assert places.process(failed) is None and places.process(poses[0]).copy is None
    assert places.process(failed._replace(refusal="")) is None and places.process(SaveMap(9)) is None
    copied = places.process(poses[1]).copy
    assert copied is not None and copied.ids == (9,) and places.process(poses[2]).copy is copied


def test_live_old_images_are_dropped_before_any_work(rig_geometry: Geometry, frames: list[Frame]) -> None:
    """One thread makes a pose of the newest images; each that is decoded gets one, however fast images come."""
    graph, statistics = Graph(policy=NEWEST, depth=1), RunStatistics()
    stages = front_end(rig_geometry)
    cameras = {
        name: graph.source(name, lambda name=name: [frame for frame in frames if frame.camera == name])  # type: ignore[misc]
        for name in CAMERAS
    }
    wire(graph, list(cameras.values()), stages, CONFIG, Outputs(counters={"statistics": statistics}))
    graph.run()
    of = graph.telemetry.of
    assert of("pair").dropped > 0 and of("odometry").dropped == 0
    assert 0 < statistics.poses == of("dewarp").processed == of("odometry").processed == of("keyframes").processed
    assert of("pair").dropped + of("pair").processed == 2 * PAIRS
