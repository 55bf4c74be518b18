"""Skew and rolling shutters: the rendered images are those of the instants that the readout says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from tests.simulation import build, make_rig, render_grey, write_log
from tests.simulation.paths import planar_poses
from tests.simulation.readout import Readout, body_twists
from tests.simulation.rigs import nominal_rig, with_real_mirrors
from tests.simulation.test_logs import decoded, messages

SIZE = 96
ROW_TWIST = np.array([2e-3, 1e-3, -5e-4, 4e-4, -3e-4, 2e-3])


@pytest.mark.parametrize("amount", [0.0, 1.0])
def test_every_row_of_a_rolling_shutter_has_its_own_pose(amount: float) -> None:
    run = build("two_walls", 4, SIZE, 3)
    upper = (with_real_mirrors(run.rig, 4, amount) if amount else run.rig).upper
    rolled = render_grey(run.scene, upper, run.poses[1], 3, ROW_TWIST)
    for row in (0, 20, 48, 90):
        there = render_grey(run.scene, upper, run.poses[1] @ se3.exp(row * ROW_TWIST), 3)
        apart, moved = (
            np.abs(image[row] - there[row]) for image in (rolled, render_grey(run.scene, upper, run.poses[1], 3))
        )
        assert np.percentile(apart, 90) < 2
        assert row == 0 or apart.mean() < 0.2 * moved.mean()


def test_twists_are_those_of_the_path_and_leave_out_a_sudden_turn() -> None:
    angle = np.linspace(0, 0.5, 11)
    poses = planar_poses(np.column_stack([np.sin(angle), 1 - np.cos(angle)]), angle)
    poses[6:, :3, :3] = poses[6:, :3, :3] @ se3.rotation_exp([0, 0, 1.6])
    twists = body_twists(poses, 0.1)
    np.testing.assert_allclose(twists[[1, 2, 4, 5]], [[0.5, 0, 0, 0, 0, 0.5]] * 4, atol=1e-12)
    assert np.abs(twists[:, 5]).max() == pytest.approx(0.5)


def test_the_upper_image_is_exposed_after_skew_and_stamp_offset(tmp_path: Path) -> None:
    run = build("rooms", 4, SIZE, 5)
    readout = Readout(speed=2.0, skew_ms=(10.0, 14.0), stamp_offset_ms=5.0)
    write_log(tmp_path, run.rig, run.poses, run.scene, sensor=run.sensor, seed=4, readout=readout)
    read = messages(tmp_path / "log.mcap")
    lower, upper = ([m for m in read if side in m[0]] for side in ("lower", "upper"))
    assert [t - lower[0][1] for _, t, _ in lower] == [0, 50_000_000, 100_000_000, 150_000_000, 200_000_000]
    assert [u[1] - m[1] for u, m in zip(upper, lower, strict=True)] == [
        10_000_000,
        11_000_000,
        12_000_000,
        13_000_000,
        14_000_000,
    ]
    T = run.poses[2] @ se3.exp(0.017 * body_twists(run.poses, 0.05)[2])
    image, expected = decoded(upper[2][2]).astype(float), render_grey(run.scene, run.rig.upper, T)
    unmoved = render_grey(run.scene, run.rig.upper, run.poses[2])
    assert np.abs(image - expected).mean() < 0.5 * np.abs(image - unmoved).mean()


def test_a_nominal_rig_knows_mirror_and_ruler_only() -> None:
    true = with_real_mirrors(make_rig(baseline_m=0.2003, misaligned_deg=(1, 0.5, 0.7), offset_mm=(3, -2)), 1)
    nominal = nominal_rig(true)
    assert nominal.baseline_m == pytest.approx(0.2005)
    assert nominal.lower.camera.center == nominal.upper.camera.center == (383.5, 383.5)
    np.testing.assert_array_equal(nominal.upper.T_cam_rig[:3, :3], nominal.lower.T_cam_rig[:3, :3])
    assert true.lower.camera != true.upper.camera
