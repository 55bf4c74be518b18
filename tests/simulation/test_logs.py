"""Recipes are reproducible, and a written log contains what was rendered."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from calib import se3
from calib.models.unified import UnifiedCamera
from calib.rig_file import read_rig
from omnid.simulation.clearance import clearance_m
from tests.simulation import RECIPES, MountedSensor, Sensor, build, corridor, make_rig, write_log
from tests.simulation.paths import approaches, back_again, spline_path, turns
from tests.simulation.recipes import TURN_DEG

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


def decoded(message: Any) -> np.ndarray:
    image = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def write(folder: Path, name: str = "misaligned", seed: int = 4, pairs: int = 3) -> Path:
    run = build(name, seed, SIZE, pairs)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed)
    return folder


def test_same_seed_gives_same_bytes(tmp_path: Path) -> None:
    one = write(tmp_path / "a", seed=4) / "log.mcap"
    corridor.cache_clear()
    again, other = (write(tmp_path / n, seed=s) / "log.mcap" for n, s in (("b", 4), ("c", 5)))
    assert one.read_bytes() == again.read_bytes()
    assert one.read_bytes() != other.read_bytes()


def test_log_has_both_cameras_and_the_stamps_of_the_ground_truth(tmp_path: Path) -> None:
    read = messages(write(tmp_path, pairs=15) / "log.mcap")
    stamps = {
        side: np.array([t for topic, t, _ in read if topic == f"/{side}/image_raw/compressed"])
        for side in ("lower", "upper")
    }
    truth = (tmp_path / "truth.txt").read_text().splitlines()
    assert [line.split()[0] for line in truth] == [f"{t // 10**9}.{t % 10**9:09d}" for t in stamps["lower"]]
    assert (np.diff(stamps["lower"]) == 100_000_000).all()
    assert 1_000_000 < np.abs(stamps["upper"] - stamps["lower"]).max() <= 2_000_000
    assert decoded(read[0][2]).shape == (SIZE, SIZE)


def test_ground_truth_and_camchain_contain_poses_and_rig(tmp_path: Path) -> None:
    run = build("misaligned", 4, SIZE, 3)
    folder = write(tmp_path)
    rows = np.loadtxt(folder / "truth.txt")
    assert np.allclose(se3.transform(se3.rotation(rows[:, 4:]), rows[:, 1:4]), run.poses, atol=1e-8)
    chain = YAML(typ="safe").load(folder / "camchain.yaml")
    for name, mounted in (("cam0", run.rig.lower), ("cam1", run.rig.upper)):
        assert np.array_equal(chain[name]["T_cam_imu"], mounted.T_cam_rig)
        assert isinstance(mounted.camera, UnifiedCamera)
        assert chain[name]["intrinsics"] == [mounted.camera.xi, *mounted.camera.focal, *mounted.camera.center]
    moved = np.array(chain["cam1"]["T_cn_cnm1"]) @ run.rig.lower.T_cam_rig
    assert np.allclose(moved, run.rig.upper.T_cam_rig)


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_every_recipe_stays_inside_its_walls(name: str) -> None:
    run = build(name, 9, SIZE, 3)
    assert len(run.poses) == 3
    x, y = run.poses[:, 0, 3], run.poses[:, 1, 3]
    low = np.min([r.corners.min(axis=0) for r in run.scene.rectangles], axis=0)
    high = np.max([r.corners.max(axis=0) for r in run.scene.rectangles], axis=0)
    assert (x > low[0] + 0.4).all() and (x < high[0] - 0.4).all()
    assert (y > low[1] + 0.4).all() and (y < high[1] - 0.4).all()


def test_spline_path_has_the_given_steps_and_turn() -> None:
    poses = spline_path(1, 60, 0.05, turn=(58, TURN_DEG))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.allclose(steps[:57], 0.05, atol=1e-4)
    assert steps[57] == pytest.approx(0.025, abs=1e-4)
    turned = np.rad2deg(np.diff(np.unwrap(se3.yaw(poses))))
    assert np.abs(turned[:57]).max() < 8
    assert turned[57] == pytest.approx(TURN_DEG, abs=5)
    along = np.einsum("ij,ij->i", np.diff(poses[:58, :2, 3], axis=0), poses[:57, :2, 0]) / steps[:57]
    assert along.min() > 0.99


def test_turns_and_return_path() -> None:
    poses = turns([10.0, -25.0], 0.03)
    assert np.rad2deg(se3.yaw(poses)) == pytest.approx([0, 10, -15])
    back = back_again(poses)
    assert len(back) == 5 and np.array_equal(back[0], back[-1])


def test_approaches_come_near_to_what_stands_around_and_go_back() -> None:
    wall = np.array([[[1.0, -2.0], [1.0, 2.0]], [[-1.0, -2.0], [-1.0, 2.0]]])
    poses = approaches(1, 300, wall)
    assert len(poses) == 300
    distances = [clearance_m(wall, (x, y), 0.0) for x, y in poses[:, :2, 3]]
    assert min(distances) == pytest.approx(0.3, abs=0.05) and min(distances) >= 0.3
    assert np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).max() <= 0.05 + 1e-9
    turned = np.rad2deg(np.diff(np.unwrap(se3.yaw(poses))))
    assert np.abs(turned).max() <= 10 + 1e-6
    at_origin = np.linalg.norm(poses[:, :2, 3], axis=1) < 1e-9
    assert at_origin[100:].any()


def test_struts_and_hub_are_dark_and_fixed() -> None:
    rig = make_rig(size=SIZE)
    sensor = Sensor(strut_angles_deg=(0.0,), strut_width=0.05, hub=0.1, noise_sigma=0)
    exposure = MountedSensor.of(sensor, rig.lower.visible, (SIZE, SIZE))
    image = exposure.expose(np.full((SIZE, SIZE), 200, np.float32), np.random.default_rng(0))
    middle = SIZE // 2
    assert image[middle, middle] < 30 and image[middle, SIZE - 10] < 30
    assert image[middle, 10] > 180 and image[10, middle] > 180


def test_only_the_masked_rig_excludes_struts(tmp_path: Path) -> None:
    write(tmp_path, "struts")
    on_hub = np.full((1, 2), SIZE / 2)
    assert read_rig(tmp_path / "rig.toml").lower.visible.contains(on_hub).all()
    assert not read_rig(tmp_path / "rig_masked.toml").lower.visible.contains(on_hub).any()


def test_noise_differs_in_every_image_of_a_standing_rig(tmp_path: Path) -> None:
    read = messages(write(tmp_path, "still") / "log.mcap")
    lower = [decoded(m).astype(float) for topic, _, m in read if "lower" in topic]
    difference = (lower[1] - lower[0])[SIZE // 3 : -SIZE // 3, SIZE // 3 : -SIZE // 3]
    assert 0.5 < difference.std() < 4
