"""evo reads poses from a recording without conversion (tested with evo 1.38.1); it reads transforms with ROS only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.interop.conftest import Known
from tests.interop.programs import program, run

pytestmark = pytest.mark.interop


@pytest.mark.parametrize("topic", ["odom", "pose"])
def test_reads_the_poses_that_were_written(known: Known, tmp_path: Path, topic: str) -> None:
    found = trajectory(known.path, tmp_path, topic)
    wanted = known.expected[f"/omnid/{topic}"]
    poses = [message["pose"]["pose"] if topic == "odom" else message["pose"] for message in wanted]
    assert len(found) == len(poses)
    for row, pose in zip(found, poses, strict=True):
        np.testing.assert_allclose(row[1:4], list(pose["position"].values()), atol=1e-15)
        np.testing.assert_allclose(row[4:], list(pose["orientation"].values()), atol=1e-15)


def trajectory(log: Path, folder: Path, topic: str) -> np.ndarray:
    """Return rows t x y z qx qy qz qw, as read and saved by evo."""
    run([program("evo_traj", "evo"), "mcap", log, f"/omnid/{topic}", "--save_as_tum"], folder)
    return np.atleast_2d(np.loadtxt(folder / f"omnid_{topic}.tum"))
