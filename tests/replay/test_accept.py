"""`omnid accept` on a rendered log: a round between two marks, found where the robot stands."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np

from tests.replay.command import Command
from tests.simulation import corridor, paths, render_grey
from tests.simulation.logs import pack_log
from tests.simulation.recipes import mild_rig

STAND = 22


def test_a_round_of_a_rendered_log(omnid: Command, tmp_path: Path) -> None:
    there = paths.spline_path(3, 33, 0.05, sway_m=0.05)
    # It starts and stops gently, as a robot does.
    along = np.rint(16 * (1 - np.cos(np.linspace(0, np.pi, 30)))).astype(int)
    steps = [*[0] * STAND, *along.tolist(), *[32] * STAND, *along[::-1].tolist(), *[0] * STAND]
    rig, scene = mild_rig(3, 256), corridor(3)

    @cache
    def seen(step: int, camera: int) -> np.ndarray:
        return render_grey(scene, (rig.lower, rig.upper)[camera], there[step])

    pack_log(tmp_path, rig, there[steps], lambda pair, camera: seen(steps[pair], camera), seed=3)
    distance_m = float(np.linalg.norm(there[-1, :3, 3] - there[0, :3, 3]))
    page = tmp_path / "accept.html"
    words = ("accept", tmp_path / "log.mcap", "--rig", tmp_path / "rig.toml", "--distance-m", distance_m, "-o", page)
    done = omnid(*words, "--json")
    assert done.code == 0, done.err
    (one,) = json.loads(done.out)["drives"]["odometry"]["rounds"]
    assert abs(one["length_error_ratio"]) < 0.005 and one["end_error_m"] < 0.01
    assert "Acceptance drive: Accepted" in page.read_text()
    for share, code in ((1.0, 0), (1.02, 1)):  # 2 % are more than the placing explains
        assert omnid("accept", tmp_path / "truth.txt", "--distance-m", share * distance_m, "--json").code == code
