"""The file of a refined rig: it comes back, and belongs to the calibration that it refines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.refined_rig import RefinedRig, calibration_digest, read_refined_rig
from calib.rig import Rig
from calib.rig_file import rig_toml


def refined(rig: Rig) -> RefinedRig:
    moved = replace(rig, upper=replace(rig.upper, T_cam_rig=se3.exp([0, 0, 0, 0.01, 0, 0]) @ rig.upper.T_cam_rig))
    return RefinedRig(moved, calibration_digest(rig), "2026-01-01", 9, 80, 0.5, 0.25, 1e-3, 1e-4)


def test_a_refined_rig_comes_back(omni_rig: Rig, tmp_path: Path) -> None:
    given = refined(omni_rig)
    (tmp_path / "a.toml").write_text(given.toml())
    found = read_refined_rig(tmp_path / "a.toml")
    assert found is not None and replace(found, rig=given.rig) == given
    assert np.allclose(found.rig.upper.T_cam_rig, given.rig.upper.T_cam_rig)
    assert "lengths +0.100 % (sigma 0.010)" in found.summary and "0.500 -> 0.250 px" in found.summary


def test_it_changes_cameras_and_leaves_masks_and_mounting(omni_rig: Rig) -> None:
    base = replace(omni_rig, T_base_rig=se3.exp([0, 0, 1, 0, 0, 0]))
    found = refined(omni_rig).applied_to(base)
    assert np.array_equal(found.T_base_rig, base.T_base_rig) and found.upper.mask is base.upper.mask
    assert not np.allclose(found.upper.T_cam_rig, base.upper.T_cam_rig)


def test_the_digest_is_that_of_the_calibration_alone(omni_rig: Rig) -> None:
    digest = calibration_digest(omni_rig)
    assert calibration_digest(replace(omni_rig, T_base_rig=se3.exp([0, 0, 1, 0, 0, 0]))) == digest
    assert calibration_digest(refined(omni_rig).rig) != digest


def test_other_files_are_no_refined_rig(omni_rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(rig_toml(omni_rig))
    assert read_refined_rig(tmp_path / "a.toml") is None
    (tmp_path / "a.toml").write_text(refined(omni_rig).toml() + "colour = 1\n")
    with pytest.raises(CalibError, match=r"refined\.colour: unknown key"):
        read_refined_rig(tmp_path / "a.toml")
