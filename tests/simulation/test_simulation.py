"""Rendered logs: the same seed gives the same bytes; images, stamps, rigs and poses are those that were asked for."""

from __future__ import annotations

import math
from importlib.util import find_spec
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
from calib.rig_file import read_rig
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.robot import make_robot, with_masks
from tests.simulation import RECIPES, build, corridor, make_rig, render, render_grey, write_log
from tests.simulation.disturbances import DISTURBANCES, Mirror, reflectance
from tests.simulation.logs import Readout, body_twists
from tests.simulation.photographs import with_photographs
from tests.simulation.rigs import MirrorCamera, nominal_rig, with_real_mirrors

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


def test_each_disturbance_changes_the_images_and_is_that_of_the_seed(tmp_path: Path) -> None:
    def log(name: str, *disturbances: str) -> bytes:
        return (write(tmp_path / name, "rooms", disturbances=disturbances) / "log.mcap").read_bytes()

    clean = log("clean")
    assert [name for name in DISTURBANCES if log(name, name) == clean] == []
    assert log("once", *DISTURBANCES) == log("again", *DISTURBANCES)


@pytest.mark.skipif(find_spec("skimage") is None, reason="needs the files of scikit-image")
def test_all_but_the_ceiling_shows_photographs_of_the_seed() -> None:
    scene = build("rooms", 3, SIZE, 3).scene
    first, again, other = (with_photographs(scene, seed).rectangles for seed in (3, 3, 4))
    for before, now, same, third in zip(scene.rectangles, first, again, other, strict=True):
        assert np.array_equal(now.texture, same.texture) and np.array_equal(now.corners, before.corners)
        is_kept = before.name == "ceiling"
        assert [np.array_equal(now.texture, one.texture) for one in (before, third)] == [is_kept, is_kept]


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


def test_only_the_masked_rig_excludes_struts(tmp_path: Path) -> None:
    write(tmp_path, "struts")
    on_hub = np.full((1, 2), SIZE / 2)
    assert read_rig(tmp_path / "rig.toml").lower.visible.contains(on_hub).all()
    assert not read_rig(tmp_path / "rig_masked.toml").lower.visible.contains(on_hub).any()


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_every_recipe_stays_inside_its_walls(name: str) -> None:
    run = build(name, 9, SIZE, 3)
    corners = np.concatenate([face.corners for face in run.scene.rectangles])[:, :2]
    xy = run.poses[:, :2, 3]
    assert len(xy) == 3 and (xy > corners.min(axis=0) + 0.4).all() and (xy < corners.max(axis=0) - 0.4).all()


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


def test_the_upper_image_is_exposed_after_skew_and_stamp_offset(tmp_path: Path) -> None:
    run = build("rooms", 4, SIZE, 5)
    write(tmp_path, "rooms", pairs=5, readout=Readout(speed=2.0, skew_ms=(10.0, 14.0), stamp_offset_ms=5.0))
    read = messages(tmp_path / "log.mcap")
    lower, upper = ([m for m in read if side in m[0]] for side in ("lower", "upper"))
    assert [t - lower[0][1] for _, t, _ in lower] == [n * 50_000_000 for n in range(5)]
    assert [u[1] - m[1] for u, m in zip(upper, lower, strict=True)] == [(10 + n) * 1_000_000 for n in range(5)]
    T = run.poses[2] @ se3.exp(0.017 * body_twists(run.poses, 0.05)[2])
    image = cv2.imdecode(upper[2][2].data, cv2.IMREAD_UNCHANGED).astype(float)
    expected, unmoved = (render_grey(run.scene, run.rig.upper, pose) for pose in (T, run.poses[2]))
    assert np.abs(image - expected).mean() < 0.5 * np.abs(image - unmoved).mean()


CENTER = (384.2, 381.1)
PIXELS = np.random.default_rng(0).uniform(60, 700, (300, 2))


def test_paraboloid_below_an_orthographic_camera_equals_the_unified_model() -> None:
    origins, rays = MirrorCamera(207.0, CENTER, (768, 768)).rays(PIXELS)
    np.testing.assert_allclose(rays, UnifiedCamera(1.0, (-207.0, 207.0), CENTER, (768, 768)).lift(PIXELS), atol=1e-12)
    np.testing.assert_allclose(np.cross(origins, rays), 0, atol=1e-12)


def test_project_inverts_the_rays_at_any_distance() -> None:
    tilted = MirrorCamera(207.0, CENTER, (768, 768), tilt_rad=(0.008, -0.006), conic=0.01, ellipticity=0.01)
    origins, rays = tilted.rays(PIXELS)
    distance = np.random.default_rng(1).uniform(0.2, 5, (len(PIXELS), 1))
    np.testing.assert_allclose(tilted.project(origins + distance * rays), PIXELS, atol=1e-7)


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


def test_a_nominal_rig_knows_mirror_and_ruler_only() -> None:
    true = with_real_mirrors(make_rig(baseline_m=0.2003, misaligned_deg=(1, 0.5, 0.7), offset_mm=(3, -2)), 1)
    nominal = nominal_rig(true)
    assert nominal.baseline_m == pytest.approx(0.2005)
    assert nominal.lower.camera.center == nominal.upper.camera.center == (383.5, 383.5)
    np.testing.assert_array_equal(nominal.upper.T_cam_rig[:3, :3], nominal.lower.T_cam_rig[:3, :3])
    assert true.lower.camera != true.upper.camera


ROBOT = make_robot(256)
RIG = with_masks(ROBOT.rig)
WALL_M = 2.0
SCENE = Scene(
    (
        Rectangle(
            np.array([-9.0, 9, 0]), np.array([18.0, 0, 0]), np.array([0, -18.0, 0]), np.zeros((8, 8), np.uint8), "floor"
        ),
        Rectangle(
            np.array([WALL_M, 3, 2.0]),
            np.array([0, -6.0, 0]),
            np.array([0, 0, -2.0]),
            np.full((8, 8), 200, np.uint8),
            "wall",
        ),
    )
)


@pytest.mark.parametrize(("angle_deg", "share"), [(0.0, 0.04), (60.0, 0.089), (75.0, 0.253), (90.0, 1.0)])
def test_the_share_is_that_of_fresnels_equations(angle_deg: float, share: float) -> None:
    cosine = np.array([math.cos(math.radians(angle_deg))], np.float32)
    assert reflectance(cosine)[0] == pytest.approx(share, abs=1e-3)


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_wall_is_seen_upside_down_where_the_floor_is(side: str) -> None:
    mounted = getattr(RIG, side)
    matt = render_grey(SCENE, mounted, RIG.T_base_rig, 2)
    polished = Mirror(mounted).reflected(matt, SCENE, SCENE.named("floor"), RIG.T_base_rig, 2)
    on_wall, in_floor = (WALL_M, 0.0, 0.4), (WALL_M, 0.0, -0.4)
    T_cam_base = mounted.T_cam_rig @ np.linalg.inv(RIG.T_base_rig)
    viewpoint = np.linalg.inv(T_cam_base)[:3, 3]
    grey, mirrored = (
        _grey(polished, mounted.camera.project((T_cam_base @ [*point, 1.0])[None, :3])) for point in (on_wall, in_floor)
    )
    ray = np.array(in_floor) - viewpoint
    share = reflectance(np.array([abs(ray[2]) / np.linalg.norm(ray)], np.float32))[0]
    assert _grey(matt, mounted.camera.project((T_cam_base @ [*in_floor, 1.0])[None, :3])) == 0.0
    assert mirrored == pytest.approx(share * grey, rel=0.03) and mirrored > 5
    np.testing.assert_array_equal(polished[matt > 100], matt[matt > 100])  # what stands is as it was


def _grey(image: np.ndarray, pixel: np.ndarray) -> float:
    u, v = np.rint(pixel[0]).astype(int)
    return float(image[v, u])
