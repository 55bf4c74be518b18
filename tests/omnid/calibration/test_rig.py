"""`omnid.calibrate_rig`: one call from pairs of images to a rig that prints itself and is saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import omnid
from calib.camera_file import read_camera
from calib.rig_file import read_rig
from omnid.calibration.rig import RigResult, _check_baseline
from omnid.errors import OmnidError
from tests.omnid.commands.test_calibrate_rig import BOARD, TRUTH, render_pairs, turn_off_deg

PAIRS = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_pairs(TRUTH, tmp_path_factory.mktemp("pairs"), PAIRS)


@pytest.fixture(scope="module")
def found(folder: Path) -> RigResult:
    """Calibrate the transform between two known cameras."""
    cameras = read_camera(folder / "lower.toml"), read_camera(folder / "upper.toml")
    return omnid.calibrate_rig(str(folder), BOARD, cameras=cameras, expected_baseline_m=0.184)


def test_the_result_prints_itself_in_one_line(found: RigResult) -> None:
    line = str(found)
    assert line.startswith("baseline 180.") and line.endswith(f"{PAIRS} pairs") and "\n" not in line
    assert not found.is_misfit


def test_what_limits_the_result_is_named(found: RigResult) -> None:
    assert [line.split(" is ")[1] for line in found.warnings] == ["2.1% off the expected 184 mm"]


def test_what_is_saved_is_the_rig(found: RigResult, tmp_path: Path) -> None:
    found.save(str(tmp_path / "rig.toml"))
    read = read_rig(tmp_path / "rig.toml")
    assert read.lower.camera == TRUTH.lower.camera and read.covariance is not None
    assert turn_off_deg(read) < 0.03


def test_a_baseline_far_from_the_expected_one_is_refused(found: RigResult) -> None:
    with pytest.raises(OmnidError, match=r"--square-mm .* would explain it"):
        _check_baseline(found.calibration, BOARD, 0.21)


def test_a_baseline_that_no_rig_has_is_refused(found: RigResult) -> None:
    T = found.calibration.T_upper_lower.copy()
    T[:3, 3] /= 100
    with pytest.raises(OmnidError, match=r"a baseline of 10 to 3000 mm, found 1\.80"):
        _check_baseline(replace(found.calibration, T_upper_lower=T), BOARD, None)
