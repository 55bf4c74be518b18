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
from tests.simulation import RECIPES, build, corridor, write_log
from tests.simulation.paths import approaches

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


def test_only_the_masked_rig_excludes_struts(tmp_path: Path) -> None:
    write(tmp_path, "struts")
    on_hub = np.full((1, 2), SIZE / 2)
    assert read_rig(tmp_path / "rig.toml").lower.visible.contains(on_hub).all()
    assert not read_rig(tmp_path / "rig_masked.toml").lower.visible.contains(on_hub).any()
