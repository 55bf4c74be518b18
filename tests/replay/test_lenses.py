"""Replays of lenses that see a part of the surroundings, and of stitched 360-degree images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnid
from calib import se3
from calib.importers import stacked_rig
from calib.models.camera import Mask
from calib.models.lens import EquidistantCamera
from calib.rig import MountedCamera
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.ray_caster import Sensor
from tests.omnid.stages.test_obstacles import scans_of
from tests.replay.command import Command
from tests.simulation import build, corridor, paths, render_grey, tum, write_log
from tests.simulation.disturbances import MountedSensor
from tests.simulation.rigs import lens, lens_rig

SIZE, PAIRS, SEEN_DEG = 256, 16, 115.0
FOOTPRINT_M = 0.3  # of the robot, on which nothing else can be: 7 cells of 5 cm square, to the next cell


def test_a_rig_of_lenses_gives_poses(tmp_path: Path) -> None:
    run = build("two_walls", seed=3, size=SIZE, pairs=PAIRS)
    center, focal = ((SIZE - 1) / 2,) * 2, (SIZE / 2 - 3) / np.deg2rad(SEEN_DEG)
    lens = EquidistantCamera((0.01, -0.002, 0.0, 0.0), (focal, focal), center, (SIZE, SIZE))
    cameras = []
    for mounted in (run.rig.lower, run.rig.upper):
        T_cam_rig = np.eye(4)
        T_cam_rig[:3, 3] = -mounted.viewpoint
        cameras.append(MountedCamera(lens, T_cam_rig, Mask(center, 0.0, SIZE / 2 - 4)))
    rig = replace(run.rig, lower=cameras[0], upper=cameras[1])
    write_log(tmp_path, rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    result = omnid.replay(tmp_path / "log.mcap", rig=tmp_path / "rig.toml")
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(tmp_path / "truth.txt"))
    assert found.pairs == PAIRS and found.ate_rmse_m < 0.003 and abs(found.length_error_ratio) < 0.01


@pytest.fixture(scope="module")
def sector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a log of two pinhole cameras that see 90 degrees behind the robot, 0.6 m above the floor."""
    folder = tmp_path_factory.mktemp("sector")
    rig = replace(
        lens_rig(lens("pinhole", 90, (480, 360)), heading_deg=-173.0),
        T_base_rig=se3.transform(np.eye(3), [0.0, 0.0, 0.6]),
    )
    poses = paths.spline_path(5, 26, 0.05, sway_m=0.02)  # what was seen before stays in view
    poses[:, 2, 3] = 0.6
    write_log(folder, rig, poses, corridor(5), seed=5)
    return folder


def test_a_sector_gives_poses(sector: Path, omnid: Command) -> None:
    """A pair that looks back across azimuth 180: the command line replays and evaluates it."""
    done = omnid("replay", sector / "log.mcap", "--rig", sector / "rig.toml", "--quiet", "--tum", sector / "out.txt")
    assert done.code == 0 and "tracking 100.0%" in done.out and "rim" not in done.err + done.out, done
    shown = omnid("eval", sector / "out.txt", sector / "truth.txt", "--json")
    found = json.loads(shown.out)
    assert abs(found["length_error_ratio"]) < 0.002 and found["ate_rmse_m"] < 0.004, found


def test_nothing_is_free_outside_of_a_sector(sector: Path) -> None:
    """Obstacles and scans know nothing of directions that the cameras do not see, from the first pair to the last."""
    found = scans_of(sector)
    assert len(found) > 10
    azimuths = np.rad2deg(np.pi * (2 * np.arange(360) + 1) / 360 - np.pi)
    off_axis_deg = np.abs((azimuths + 173 + 180) % 360 - 180)
    outside, inside = off_axis_deg > 45 + 15, off_axis_deg < 45 - 15
    for scan in found:
        assert np.isnan(scan.ranges_m[outside]).all()
        assert (scan.free_m[outside] <= FOOTPRINT_M).all(), np.nanmax(scan.free_m[outside])
    assert (found[2].free_m[inside] > 0.8).mean() > 0.5  # later the robot stands on floor that it never saw


FEW, START_NS, PERIOD_NS, BASELINE_M, SEED = 8, 1_706_000_000 * 10**9, 100_000_000, 0.191, 2
STITCHED = (1440, 720)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the stitched images of both cameras in folders, named by their stamps."""
    folder = tmp_path_factory.mktemp("stitched")
    rig, poses, scene = stacked_rig(STITCHED, BASELINE_M), paths.spline_path(SEED, FEW, 0.05), corridor(SEED)
    stamps = START_NS + PERIOD_NS * np.arange(FEW, dtype=np.int64)
    for name, mounted in (("images_bottom", rig.lower), ("images_top", rig.upper)):
        (folder / name).mkdir()
        sensor, rng = MountedSensor(Sensor(), mounted.visible, mounted.camera.size), np.random.default_rng(SEED)
        for stamp, T in zip(stamps.tolist(), poses, strict=True):
            image = sensor.expose(render_grey(scene, mounted, T, 1), rng)
            cv2.imwrite(str(folder / name / f"{stamp}.png"), image)
    (folder / "truth.txt").write_text(tum(stamps, poses))
    return folder


def test_stitched_images_are_imported_replayed_and_right_to_a_thousandth(
    recording: Path, tmp_path: Path, omnid: Command
) -> None:
    rig, found = tmp_path / "rig.toml", tmp_path / "out.txt"
    made = omnid("calibrate", "import", "--equirectangular", "1440x720", "--baseline", BASELINE_M, "-o", rig)
    assert made.code == 0 and "lower equirectangular" in made.out and "baseline 191.0 mm" in made.out
    done = omnid("replay", recording, "--rig", rig, "--quiet", "--tum", found)
    assert done.code == 0 and "tracking 100.0%" in done.out and "rim" not in done.out + done.err, done
    errors = json.loads(omnid("eval", found, recording / "truth.txt", "--json").out)
    assert abs(errors["length_error_ratio"]) < 0.001 and errors["ate_rmse_m"] < 0.001, errors
