"""Masks of the reflections of lenses, from a rendered log in which the robot turns on the spot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import omnid
from calib.rig_file import read_rig
from omnid.calibration.mask import MaskCalibration
from omnid.cli import main
from tests.simulation.disturbances import REFLECTION_RADIUS
from tests.simulation.logs import write_log
from tests.simulation.recipes import build

SIZE_PX, PAIRS = 200, 24


def command(*words: object) -> int:
    return main(["calibrate", *map(str, words)])


@pytest.fixture(scope="module")
def spin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spin")
    run = build("spin", seed=3, size=SIZE_PX, pairs=PAIRS)
    write_log(folder, run.rig, run.poses, run.scene, seed=3, supersample=1, disturbances=("flare",))
    return folder


@pytest.fixture(scope="module")
def found(spin: Path) -> MaskCalibration:
    return omnid.calibrate_mask(spin / "log.mcap", spin / "rig.toml")


def test_the_reflection_is_masked_and_the_world_is_not(spin: Path, found: MaskCalibration) -> None:
    assert 0.005 < found.share < 0.15 and f"{100 * found.share:.1f} %" in str(found)
    before = read_rig(spin / "rig.toml")
    for was, mounted in ((before.lower, found.rig.lower), (before.upper, found.rig.upper)):
        assert mounted.mask is not None and mounted.mask.image is not None
        v, u = np.nonzero(mounted.mask.image == 0)
        rim_px = min(was.visible.outer_px, SIZE_PX / 2)
        radius = np.hypot(u - was.visible.center[0], v - was.visible.center[1]) / rim_px
        # Its light lies between 1.5 and 2.5 of REFLECTION_RADIUS of the rim's radius; a band-pass spreads the border.
        assert radius.size and radius.min() > 1.3 * REFLECTION_RADIUS and radius.max() < 3.2 * REFLECTION_RADIUS


def test_the_command_writes_a_rig_that_needs_no_other_mask(
    spin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], found: MaskCalibration
) -> None:
    masked = tmp_path / "rig.toml"
    words = ("drive", spin / "log.mcap", "--only", "mask", "--rig")
    assert command(*words, spin / "rig.toml", "-o", masked) == 0
    assert f"{found}\n{masked}: written" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"rig.toml", "rig.lower.png", "rig.upper.png"}
    assert command(*words, masked) == 0
    assert capsys.readouterr().out.startswith("nothing is fixed to the cameras that the masks do not hide")


def test_a_robot_that_hardly_turns_is_refused(scene: Path) -> None:
    with pytest.raises(omnid.OmnidError, match=r"shows \d of 16 headings of a turn, 12 are needed: record a log"):
        omnid.calibrate_mask(scene / "log.mcap", scene / "rig.toml")
