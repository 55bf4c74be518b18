"""Rendered logs: the same seed gives the same bytes; images, stamps, rigs and poses are those that were asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from calib import se3
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.world import clearance_m
from tests.simulation import build, corridor, render, render_grey, write_log
from tests.simulation.harmless_worlds import FLOORS, NAMES, can_drive
from tests.simulation.hazard_worlds import HAZARDS, OF_ROBOT, trial
from tests.simulation.logs import Readout, body_twists
from tests.simulation.rigs import MirrorCamera, with_real_mirrors

SIZE = 96
SCHEMA = "sensor_msgs/msg/CompressedImage"


def messages(path: Path) -> list[tuple[str, int, Any]]:
    """Return (topic, stamp, message) in the order of arrival."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        raw = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
    read: list[tuple[str, Any]] = [(topic, store.deserialize_cdr(data, SCHEMA)) for topic, data in raw]
    return [(topic, m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, m) for topic, m in read]


def write(folder: Path, name: str = "misaligned", seed: int = 4, pairs: int = 3, **options: Any) -> Path:
    run = build(name, seed, SIZE, pairs)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed, **options)
    return folder


def test_same_seed_gives_same_bytes(tmp_path: Path) -> None:
    one = write(tmp_path / "a", seed=4) / "log.mcap"
    corridor.cache_clear()
    again, other = (write(tmp_path / n, seed=s) / "log.mcap" for n, s in (("b", 4), ("c", 5)))
    assert one.read_bytes() == again.read_bytes()
    assert one.read_bytes() != other.read_bytes()


def test_log_has_both_cameras_and_the_stamps_poses_and_rig_of_the_truth(tmp_path: Path) -> None:
    run, read = build("misaligned", 4, SIZE, 15), messages(write(tmp_path, pairs=15) / "log.mcap")
    lower, upper = (
        np.array([t for topic, t, _ in read if topic == f"/{side}/image_raw/compressed"]) for side in ("lower", "upper")
    )
    assert (np.diff(lower) == 100_000_000).all() and 1_000_000 < np.abs(upper - lower).max() <= 2_000_000
    assert cv2.imdecode(read[0][2].data, cv2.IMREAD_UNCHANGED).shape == (SIZE, SIZE)
    truth = (tmp_path / "truth.txt").read_text().splitlines()
    assert [line.split()[0] for line in truth] == [f"{t // 10**9}.{t % 10**9:09d}" for t in lower]
    rows = np.loadtxt(truth)
    assert np.allclose(se3.transform(se3.rotation(rows[:, 4:]), rows[:, 1:4]), run.poses, atol=1e-8)
    chain = YAML(typ="safe").load(tmp_path / "camchain.yaml")
    for name, mounted in (("cam0", run.rig.lower), ("cam1", run.rig.upper)):
        assert np.array_equal(chain[name]["T_cam_imu"], mounted.T_cam_rig)
        assert isinstance(mounted.camera, UnifiedCamera)
        assert chain[name]["intrinsics"] == [mounted.camera.xi, *mounted.camera.focal, *mounted.camera.center]
    assert np.allclose(np.array(chain["cam1"]["T_cn_cnm1"]) @ run.rig.lower.T_cam_rig, run.rig.upper.T_cam_rig)


# Skew, rolling shutters, real mirrors


@pytest.mark.parametrize("amount", [0.0, 1.0])
def test_every_row_of_a_rolling_shutter_has_its_own_pose(amount: float) -> None:
    run, twist = build("two_walls", 4, SIZE, 3), np.array([2e-3, 1e-3, -5e-4, 4e-4, -3e-4, 2e-3])
    upper = (with_real_mirrors(run.rig, 4, amount) if amount else run.rig).upper
    rolled, still = (render_grey(run.scene, upper, run.poses[1], 3, by) for by in (twist, None))
    for row in (0, 20, 48, 90):
        there = render_grey(run.scene, upper, run.poses[1] @ se3.exp(row * twist), 3)
        apart, moved = (np.abs(image[row] - there[row]) for image in (rolled, still))
        assert np.percentile(apart, 90) < 2
        assert row == 0 or apart.mean() < 0.2 * moved.mean()


def test_the_upper_image_is_exposed_after_the_skew(tmp_path: Path) -> None:
    run = build("rooms", 4, SIZE, 5)
    write(tmp_path, "rooms", pairs=5, readout=Readout(speed=2.0, skew_ms=(10.0, 14.0)))
    read = messages(tmp_path / "log.mcap")
    lower, upper = ([m for m in read if side in m[0]] for side in ("lower", "upper"))
    assert [t - lower[0][1] for _, t, _ in lower] == [n * 50_000_000 for n in range(5)]
    assert [u[1] - m[1] for u, m in zip(upper, lower, strict=True)] == [(10 + n) * 1_000_000 for n in range(5)]
    T = run.poses[2] @ se3.exp(0.012 * body_twists(run.poses, 0.05)[2])
    image = cv2.imdecode(upper[2][2].data, cv2.IMREAD_UNCHANGED).astype(float)
    expected, unmoved = (render_grey(run.scene, run.rig.upper, pose) for pose in (T, run.poses[2]))
    assert np.abs(image - expected).mean() < 0.5 * np.abs(image - unmoved).mean()


def test_a_rendered_spot_near_a_tilted_camera_equals_the_projection() -> None:
    """At 0.25 m the ray's origin on the mirror moves the image by about a pixel."""
    camera = MirrorCamera(52.0, (95.5, 95.5), (192, 192), tilt_rad=(0.05, -0.03), conic=0.05)
    edge_u, edge_v = np.array([0.012, -0.024, 0.0]), np.array([0.01, 0.005, -0.025])
    spot = Rectangle(np.array([0.2, 0.1, 0.1]) - (edge_u + edge_v) / 2, edge_u, edge_v, np.full((8, 8), 255, np.uint8))
    mounted = MountedCamera(camera, np.eye(4), Mask(camera.center, 0.0, 92.0))
    image = render(Scene((spot,)), mounted, np.eye(4), 4).astype(float)
    rows, columns = np.indices(image.shape)
    centroid = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    grid = spot.points(np.stack(np.meshgrid(*2 * [np.linspace(0.05, 0.95, 10)]), axis=-1).reshape(-1, 2))
    np.testing.assert_allclose(centroid, camera.project(grid).mean(axis=0), atol=0.1)


ROBOT_M = 0.2, 1.2  # radius and height
ALIKE = {f"{floor}_hall" for floor in FLOORS if floor != "plain"} | set(OF_ROBOT) - {"lean_1deg"}


@pytest.mark.parametrize("name", sorted({*NAMES, *OF_ROBOT} - ALIKE))
def test_nothing_stands_in_the_way_of_harmless_worlds(name: str) -> None:
    asked = trial(name, 1)
    segments = asked.world.obstacles(ROBOT_M[1])
    if asked.goal is not None:
        assert can_drive(segments, (0.0, 0.0), asked.goal[:2])
        assert not can_drive(segments, (0.0, 0.0), (30.0, 15.0))
        return
    along = np.arange(0.0, asked.way_m, 0.1)
    assert min(clearance_m(segments, (x_m, 0.0), ROBOT_M[0]) for x_m in along) > 0.2


@pytest.mark.parametrize("name", [name for name in HAZARDS if not name.startswith("plain_")])
def test_something_is_in_the_way_of_hazards(name: str) -> None:
    asked = trial(name, 1)
    segments = asked.world.obstacles(ROBOT_M[1])
    assert clearance_m(segments, (0.0, 0.0), ROBOT_M[0]) > 0.1
    if name == "steep_ramp":
        assert asked.world.ground.heights_m(asked.way_m) < -0.7
    elif asked.motion == "ahead" and not asked.world.people:
        along = np.arange(0.0, 4.8, 0.05)
        assert min(clearance_m(segments, (x_m, 0.0), ROBOT_M[0]) for x_m in along) < 0.0
