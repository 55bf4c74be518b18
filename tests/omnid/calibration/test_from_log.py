"""Height, tilt and masks of a rig by a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import omnid
from calib import se3
from calib.rig_file import read_rig
from omnid.calibration.from_log import HeightCalibration, MaskCalibration, on_floor
from omnid.cli import main
from omnid.core.floor import Floor
from tests.simulation.disturbances import REFLECTION_RADIUS
from tests.simulation.logs import write_log
from tests.simulation.recipes import build
from tests.simulation.rigs import make_rig

HEIGHT_M = 1.2  # of rendered rigs: tests/simulation/paths.py
SIZE_PX, PAIRS = 200, 24


def command(*words: object) -> int:
    return main(["calibrate", *map(str, words)])


@pytest.fixture(scope="module")
def found(scene: Path) -> HeightCalibration:
    return omnid.calibrate_height(str(scene / "log.mcap"), scene / "rig.toml")


def test_the_height_is_found_within_its_sigma(found: HeightCalibration) -> None:
    assert abs(found.floor.height_m - HEIGHT_M) < 2 * found.floor.sigma_m < 0.08
    assert found.rig.height_m() == pytest.approx(found.floor.height_m) and found.before.height_m() is None
    assert f"{found.floor.height_m:.3f} m (sigma" in str(found)


def test_a_tilted_rig_is_found_tilted(scene: Path) -> None:
    """By 1.5 degrees, more than the sigma of the prior, which draws it towards 0."""
    T_base_rig = se3.transform(se3.rotation_exp(np.deg2rad([0.0, 1.5, 0.0])), np.array([0.2, 0.0, 0.7]))
    rig = replace(read_rig(scene / "rig.toml"), T_base_rig=T_base_rig)
    floor = omnid.calibrate_height(scene / "log.mcap", rig).floor
    assert abs(floor.height_m - HEIGHT_M) < 0.05 and floor.a < -np.deg2rad(0.3)
    assert np.hypot(floor.a + np.deg2rad(1.5), floor.b) < 2.5 * floor.sigma_rad


@pytest.mark.parametrize("sigma_deg", [0.1, 2.0])
def test_a_rig_is_levelled_where_its_tilt_is_more_than_its_noise(sigma_deg: float) -> None:
    T_base_rig = se3.transform(se3.rotation_exp(np.deg2rad([0.0, 1.5, 0.0])), np.array([0.2, 0.1, 0.0]))
    rig = replace(make_rig(), T_base_rig=T_base_rig)
    floor = Floor(HEIGHT_M, -np.tan(np.deg2rad(1.5)), 0.0, 0.01, np.deg2rad(sigma_deg))
    found = on_floor(rig, floor).T_base_rig
    up = np.array([0.0, 0.0, 1.0]) if sigma_deg < 1 else T_base_rig[2, :3]
    np.testing.assert_allclose(found[2, :3], up, atol=1e-3)
    np.testing.assert_allclose(found[:3, 3], [0.2, 0.1, HEIGHT_M], atol=0.02)


def test_the_command_writes_the_rig_unless_the_ruler_contradicts(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], found: HeightCalibration
) -> None:
    words = ("drive", scene / "log.mcap", "--only", "height", "--rig", scene / "rig.toml", "-o", tmp_path / "rig.toml")
    assert command(*words, "--ruler-m", found.floor.height_m + 0.3) == 1
    assert "nothing was written" in capsys.readouterr().err and not (tmp_path / "rig.toml").exists()
    assert command(*words, "--ruler-m", f"{found.floor.height_m:.2f}") == 0
    out = capsys.readouterr().out
    assert str(found) in out and "no height of the cameras" in out and "by ruler agrees" in out
    assert read_rig(tmp_path / "rig.toml").height_m() == pytest.approx(found.floor.height_m)


def test_a_log_without_a_floor_ends_with_one_line(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnid.core.floor.LEAST_EVIDENCE", np.inf)
    with pytest.raises(omnid.OmnidError, match="the floor is not seen in"):
        omnid.calibrate_height(scene / "log.mcap", read_rig(scene / "rig.toml"))


@pytest.fixture(scope="module")
def spin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spin")
    run = build("spin", seed=3, size=SIZE_PX, pairs=PAIRS)
    write_log(folder, run.rig, run.poses, run.scene, seed=3, supersample=1, disturbances=("flare",))
    return folder


@pytest.fixture(scope="module")
def masks(spin: Path) -> MaskCalibration:
    return omnid.calibrate_mask(spin / "log.mcap", spin / "rig.toml")


def test_the_reflection_is_masked_and_the_world_is_not(spin: Path, masks: MaskCalibration) -> None:
    assert 0.005 < masks.share < 0.15 and f"{100 * masks.share:.1f} %" in str(masks)
    before = read_rig(spin / "rig.toml")
    for was, mounted in ((before.lower, masks.rig.lower), (before.upper, masks.rig.upper)):
        assert mounted.mask is not None and mounted.mask.image is not None
        v, u = np.nonzero(mounted.mask.image == 0)
        rim_px = min(was.visible.outer_px, SIZE_PX / 2)
        radius = np.hypot(u - was.visible.center[0], v - was.visible.center[1]) / rim_px
        # Its light lies between 1.5 and 2.5 of REFLECTION_RADIUS of the rim's radius; a band-pass spreads the border.
        assert radius.size and radius.min() > 1.3 * REFLECTION_RADIUS and radius.max() < 3.2 * REFLECTION_RADIUS


def test_the_command_writes_a_rig_that_needs_no_other_mask(
    spin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], masks: MaskCalibration
) -> None:
    masked = tmp_path / "rig.toml"
    words = ("drive", spin / "log.mcap", "--only", "mask", "--rig")
    assert command(*words, spin / "rig.toml", "-o", masked) == 0
    assert f"{masks}\n{masked}: written" in capsys.readouterr().out
    assert command(*words, masked) == 0
    assert capsys.readouterr().out.startswith("nothing is fixed to the cameras that the masks do not hide")


def test_a_robot_that_hardly_turns_is_refused(scene: Path) -> None:
    with pytest.raises(omnid.OmnidError, match=r"shows \d of 16 headings of a turn, 12 are needed: record a log"):
        omnid.calibrate_mask(scene / "log.mcap", scene / "rig.toml")
