"""The file of the refined rig: which one a start uses, and what a run does not write over."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.refined_rig import calibration_digest, read_refined_rig
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.errors import OmnidError
from omnid.refinement.estimate import RigChange
from omnid.refinement.refined_file import RefinedRigFile
from omnid.simulation.rendering.rigs import make_rig


def change(base: Rig, turn_deg: float = 0.1, lengths: float = 3e-3) -> RigChange:
    """Return a change that turns the upper camera about the baseline."""
    rig = base.with_upper_moved(np.array([0, 0, np.deg2rad(turn_deg)]), np.zeros(2))
    return RigChange(rig, ("r_z",), np.zeros(1), np.ones(1), np.full(1, 0.01), lengths, 1e-4, 0.2, 0.1, 20, 500)


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """Return the path of a calibration."""
    write_rig(tmp_path / "rig.toml", make_rig(size=256))
    return tmp_path / "rig.toml"


def opened(base: Path) -> RefinedRigFile:
    """Return the refined file of a calibration."""
    return RefinedRigFile(base.with_name("rig.refined.toml"), read_rig(base), base)


def started(base: Path, *, is_wanted: bool = True) -> tuple[RefinedRigFile, Rig, list[tuple[int, str]]]:
    """Return the file, the rig of a start, and the lines about it."""
    file, lines = opened(base), list[tuple[int, str]]()
    return file, file.start(lambda level, line: lines.append((level, line)), is_wanted=is_wanted), lines


def test_a_start_uses_the_refined_cameras_with_the_masks_topics_and_pose_of_the_calibration(base: Path) -> None:
    calibration = read_rig(base)
    opened(base).write(change(calibration))
    T_base_rig = se3.exp([0.1, 0.0, 0.5, 0.0, 0.0, 0.2])
    write_rig(base, replace(calibration, T_base_rig=T_base_rig, topics=("/a", "/b")))
    file, rig, ((level, line),) = started(base)
    assert file.used is not None and level == logging.INFO
    assert f"{file.path}, refined 2" in line and "lengths +0.300 %" in line and f"go back to {base}" in line
    turned = se3.rotation_log(rig.upper.T_cam_rig[:3, :3] @ calibration.upper.T_cam_rig[:3, :3].T)
    assert np.rad2deg(np.linalg.norm(turned)) == pytest.approx(0.1, abs=1e-6)
    assert rig.topics == ("/a", "/b") and np.allclose(rig.T_base_rig, T_base_rig)


def test_a_start_that_only_reports_names_the_file_and_uses_the_calibration(base: Path) -> None:
    opened(base).write(change(read_rig(base)))
    file, rig, ((level, line),) = started(base, is_wanted=False)
    assert file.used is None and level == logging.INFO and "not used" in line and "rig.refine" in line
    assert calibration_digest(rig) == calibration_digest(read_rig(base))
    assert started(base.with_name("rig.refined.toml"), is_wanted=False)[2][0][0] == logging.WARNING


def test_no_file_is_no_line(base: Path) -> None:
    assert started(base)[2] == [] and started(base)[0].used is None


@pytest.mark.hazard("H36")
def test_the_file_of_another_calibration_is_not_used_and_is_replaced(base: Path) -> None:
    opened(base).write(change(read_rig(base)))
    again = read_rig(base).with_upper_moved(np.array([0, 0, 1e-3]), np.zeros(2))
    write_rig(base, again)
    file, rig, ((level, line),) = started(base)
    assert file.used is None and level == logging.WARNING and "calibrated since" in line and "delete it" in line
    assert calibration_digest(rig) == calibration_digest(again)
    file.write(change(again))
    assert started(base)[0].used is not None


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[: len(data) // 2],
        lambda data: b"\xff" * 99,
        lambda data: data.replace(b"lengths = ", b"lengths = nan #"),
        lambda data: data + b"unknown = 1\n",
    ],
    ids=["empty", "half", "no text", "nan", "unknown key"],
)
def test_a_damaged_file_is_reported_and_the_calibration_used(base: Path, damage: Callable[[bytes], bytes]) -> None:
    file = opened(base)
    file.write(change(read_rig(base)))
    file.path.write_bytes(damage(file.path.read_bytes()))
    file, rig, ((level, line),) = started(base)
    assert file.used is None and level == logging.WARNING and str(file.path) in line and f"uses {base}" in line
    assert calibration_digest(rig) == calibration_digest(read_rig(base))
    damaged = file.path.read_bytes()
    with pytest.raises(CalibError):
        file.write(change(rig))
    assert file.path.read_bytes() == damaged, "what omnid has not written stays"


def test_a_rig_of_the_user_and_the_calibration_itself_are_never_written(base: Path) -> None:
    file, calibration = opened(base), read_rig(base)
    write_rig(file.path, calibration)
    content = file.path.read_bytes()
    with pytest.raises(OmnidError, match="no run of omnid has refined"):
        file.write(change(calibration))
    assert file.path.read_bytes() == content
    file.path.unlink()
    opened(base).write(change(calibration))
    adopted = RefinedRigFile(file.path, read_rig(file.path), file.path)  # cameras.rig = "rig.refined.toml"
    content = file.path.read_bytes()
    with pytest.raises(OmnidError, match="name another one"):
        adopted.write(change(calibration))
    assert file.path.read_bytes() == content


@pytest.mark.hazard("H36")
def test_the_limits_hold_against_the_calibration_from_run_to_run(base: Path) -> None:
    file = opened(base)
    file.write(change(read_rig(base), 0.7, 0.03))
    file, rig, _ = started(base)
    with pytest.raises(OmnidError, match=r"too large .*1\.40 deg"):
        file.write(change(rig, 0.7, 0.0))
    with pytest.raises(OmnidError, match=r"lengths by \+6\.09 %"):
        file.write(change(rig, 0.0, 0.03))
    file.write(change(rig, 0.1, 0.01))
    found = read_refined_rig(file.path)
    assert found is not None and found.lengths == pytest.approx(1.03 * 1.01 - 1) and found.keyframes == 20
    assert found.base_sha256 == calibration_digest(read_rig(base))


@pytest.mark.parametrize("was_there", [False, True])
def test_a_window_that_the_rig_fits_takes_back_what_this_run_has_written(base: Path, *, was_there: bool) -> None:
    if was_there:
        opened(base).write(change(read_rig(base), 0.2))
    file, rig, _ = started(base)
    before = file.path.read_bytes() if was_there else None
    assert not file.withdraw()
    for turn_deg in (0.1, 0.3):
        file.write(change(rig, turn_deg))
    assert file.withdraw() and not file.withdraw()
    assert (file.path.read_bytes() if file.path.exists() else None) == before


def test_a_folder_that_cannot_be_written_is_one_line(base: Path) -> None:
    file = RefinedRigFile(base.parent / "missing" / "rig.toml", read_rig(base), base)
    with pytest.raises(OmnidError, match="cannot write the file"):
        file.write(change(read_rig(base)))
