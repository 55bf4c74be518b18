"""`omnid calibrate drive --only check` on rendered logs: right, drifted and broken rigs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.models.unified import UnifiedCamera
from calib.rig_file import read_rig, write_rig
from omnid.calibration.images import BY_NAME
from omnid.calibration.rig_check import RigCheckResult, check_rig, read_rig_pairs
from omnid.cli import main
from omnid.core.rig.rig_health import RigState
from omnid.messages import FramePair
from tests.replay.edited import images, save
from tests.simulation import build, write_log
from tests.simulation.logs import Readout
from tests.simulation.rigs import with_upper_rotated

Turn = tuple[float, float, float]


PAIRS = 12  # the error of a turn is a third of what tests allow


@pytest.fixture(scope="module")
def drive(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the log of the first half of the scene, and its rig.toml."""
    folder = tmp_path_factory.mktemp("drive")
    save(folder / "log.mcap", (image for image in images(scene / "log.mcap") if image.pair < PAIRS))
    shutil.copy(scene / "rig.toml", folder)
    return folder


@pytest.fixture(scope="module")
def pairs(drive: Path) -> list[FramePair]:
    rig = read_rig(drive / "rig.toml")
    return read_rig_pairs(drive / "log.mcap", rig, BY_NAME)


def check_rotated(drive: Path, pairs: list[FramePair], turn_deg: Turn) -> RigCheckResult:
    return check_rig(pairs, with_upper_rotated(read_rig(drive / "rig.toml"), turn_deg))


def test_motion_between_the_exposures_is_no_drift(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = build("two_walls", 3, 256, 8)
    write_log(tmp_path, drive.rig, drive.poses, drive.scene, readout=Readout(skew_ms=(-20.0, -20.0)), supersample=1)
    words = (tmp_path / "log.mcap", "--rig", tmp_path / "rig.toml")
    assert run(*words) == 2
    assert "without --only the times of exposure are calibrated" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("turn_deg", "state"),
    [
        ((0.0, 0.0, 0.0), RigState.FITS),
        ((0.5, 0.0, 0.0), RigState.DRIFTED),
        ((0.0, 0.5, 0.0), RigState.DRIFTED),
        ((0.0, 0.0, -0.5), RigState.DRIFTED),
        ((0.0, 0.0, 11.0), RigState.BROKEN),
    ],
)
def test_every_axis_is_measured(drive: Path, pairs: list[FramePair], turn_deg: Turn, state: RigState) -> None:
    found = check_rotated(drive, pairs, turn_deg).finding
    assert found.state is state and found.drift is not None
    assert np.rad2deg(found.drift.turn) == pytest.approx(turn_deg, abs=0.05 if state is not RigState.BROKEN else 0.1)


def test_exchanged_images_do_not_fit_and_dark_ones_say_nothing(drive: Path, pairs: list[FramePair]) -> None:
    exchanged = [replace(pair, lower=pair.upper, upper=pair.lower) for pair in pairs]
    assert check_rotated(drive, exchanged, (0, 0, 0)).finding.state is not RigState.FITS
    dark = [replace(pair, lower=np.zeros_like(pair.lower), upper=np.zeros_like(pair.upper)) for pair in pairs]
    found = check_rotated(drive, dark, (0, 0, 0))
    assert found.finding.state is RigState.UNCHECKED


def run(*words: object) -> int:
    return main(["calibrate", "drive", *map(str, words), "--only", "check"])


def test_command_reports_a_drift(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, wrong = drive / "log.mcap", tmp_path / "wrong.toml"
    write_rig(wrong, with_upper_rotated(read_rig(drive / "rig.toml"), (0.6, -0.4, 1.5)))
    assert run(log, "--rig", drive / "rig.toml") == 0
    assert capsys.readouterr().out.startswith("fits: ")
    assert run(log, "--rig", wrong) == 1
    assert capsys.readouterr().out.startswith("drifted: upper camera turned by 1.6")


def test_a_shifted_centre_is_no_rig_that_fits(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = read_rig(drive / "rig.toml")
    camera = rig.upper.camera
    assert isinstance(camera, UnifiedCamera)
    off = replace(camera, center=(camera.center[0] + 2.0, camera.center[1]))
    write_rig(tmp_path / "rig.toml", replace(rig, upper=replace(rig.upper, camera=off)))
    assert run(drive / "log.mcap", "--rig", tmp_path / "rig.toml") == 1
    assert capsys.readouterr().out.startswith(("drifted", "broken"))
