"""Two fisheye lenses one above the other, which look up and see the horizon: imported from Kalibr and replayed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import omnid
from calib.models.camera import Mask
from calib.models.lens import EquidistantCamera
from calib.rig import MountedCamera
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.simulation import build, write_log

SIZE, PAIRS, SEEN_DEG = 256, 16, 115.0


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
