"""`omnid accept` on a rendered log: a round between two marks, found where the robot stands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.replay.command import Command
from tests.simulation import corridor, paths, write_log
from tests.simulation.recipes import mild_rig

STAND = 22


def test_a_round_of_a_rendered_log(omnid: Command, tmp_path: Path) -> None:
    there = paths.spline_path(3, 33, 0.05, sway_m=0.05)
    # It starts and stops gently, as a robot does.
    along = np.rint(16 * (1 - np.cos(np.linspace(0, np.pi, 40)))).astype(int)
    poses = there[[*[0] * STAND, *along, *[32] * STAND, *along[::-1], *[0] * STAND]]
    write_log(tmp_path, mild_rig(3, 256), poses, corridor(3), seed=3)
    distance_m = float(np.linalg.norm(there[-1, :3, 3] - there[0, :3, 3]))
    page = tmp_path / "accept.html"
    words = ("accept", tmp_path / "log.mcap", "--rig", tmp_path / "rig.toml", "--distance-m", distance_m, "-o", page)
    done = omnid(*words, "--json")
    assert done.code == 0, done.err
    (one,) = json.loads(done.out)["drives"]["odometry"]["rounds"]
    assert abs(one["length_error_ratio"]) < 0.005 and one["end_error_m"] < 0.01
    assert "Acceptance drive: Accepted" in page.read_text()
    assert omnid(*words[:5], 1.02 * distance_m, "--json").code == 1, "2 % are more than the placing explains"
