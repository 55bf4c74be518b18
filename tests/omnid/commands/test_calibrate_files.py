"""`omnid calibrate import` and `export`: files, printed line, errors before files are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.kalibr import export_kalibr
from calib.models.lens import DoubleSphereCamera
from calib.ocam_file import export_ocam
from calib.rig import Rig, ShutterTimes
from calib.rig_file import read_rig, write_rig
from omnid.cli import parser_of
from omnid.errors import OmnidError


def omnid(*words: object) -> int:
    args = parser_of(given := ["calibrate", *map(str, words)]).parse_args(given)
    status: int = args.command.run(args)
    return status


def test_imports_and_exports_kalibr_files(omni_rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "k.yaml").write_text(export_kalibr(omni_rig))
    assert omnid("import", tmp_path / "k.yaml", "-o", tmp_path / "rig.toml") == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert f"baseline {omni_rig.baseline_m * 1e3:.1f} mm" in line and "upper rotated by 14.4" in line
    assert "lower omni 768x770, 0 to 117 deg from its axis (/front/lower/image_raw), upper omni 780x768, 0 to " in line
    assert omnid("export", tmp_path / "rig.toml", "--format", "kalibr", "-o", tmp_path / "again.yaml") == 0
    assert omnid("import", tmp_path / "again.yaml", "-o", tmp_path / "again.toml") == 0
    assert (tmp_path / "again.toml").read_text() == (tmp_path / "rig.toml").read_text()
    assert omnid("import", tmp_path / "k.yaml", "--lower", "cam1", "-o", tmp_path / "swapped.toml") == 0
    assert read_rig(tmp_path / "swapped.toml").lower.camera == omni_rig.upper.camera


def test_says_what_an_import_takes_from_the_imu(
    omni_rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = export_kalibr(omni_rig).replace("cam0:", "cam0:\n  timeshift_cam_imu: 0.002")
    text = text.replace("cam1:", "cam1:\n  timeshift_cam_imu: 0.005").replace("lower/", "a/").replace("upper/", "b/")
    (tmp_path / "k.yaml").write_text(text)
    assert omnid("import", tmp_path / "k.yaml", "-o", tmp_path / "rig.toml") == 0
    printed = capsys.readouterr()
    assert "upper exposed +3.0 ms against its stamps" in printed.out
    assert f"omnid: warning: {tmp_path / 'k.yaml'}: lower is cam0 by z of the IMU" in printed.err
    assert read_rig(tmp_path / "rig.toml").times.upper_delay_s == pytest.approx(0.003)


def test_the_line_says_how_far_a_lens_sees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A rectified camera of 1241x376 px reaches 42 degrees to its corners, not the 15 to its upper edge."""
    cameras = "".join(
        f"""
cam{n}:
  camera_model: pinhole
  intrinsics: [718.9, 718.9, 607.2, 185.2]
  distortion_model: radtan
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [1241, 376]
  rostopic: /{name}/image
"""
        for n, name in enumerate(("lower", "upper"))
    )
    chain = "  T_cn_cnm1: [[1, 0, 0, 0], [0, 1, 0, 0.54], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (tmp_path / "k.yaml").write_text(cameras + chain)
    assert omnid("import", tmp_path / "k.yaml", "-o", tmp_path / "rig.toml") == 0
    assert "lower omni 1241x376, 0 to 42 deg from its axis" in capsys.readouterr().out


def test_imports_and_exports_ocam_files(ocam_rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_rig(tmp_path / "rig.toml", ocam_rig)
    assert omnid("export", tmp_path / "rig.toml", "--format", "ocam", "-o", tmp_path / "o") == 0
    assert "left out, because the format does not support it: T_base_rig" in capsys.readouterr().out
    files = ["--lower", tmp_path / "o.lower.txt", "--upper", tmp_path / "o.upper.txt"]
    assert omnid("import", *files, "--transform", tmp_path / "o.transform.toml", "-o", tmp_path / "again.toml") == 0
    again = read_rig(tmp_path / "again.toml")
    assert (again.lower.camera, again.upper.camera) == (ocam_rig.lower.camera, ocam_rig.upper.camera)
    np.testing.assert_allclose(
        again.lower.T_cam_rig @ se3.inverse(again.upper.T_cam_rig),
        ocam_rig.lower.T_cam_rig @ se3.inverse(ocam_rig.upper.T_cam_rig),
        atol=1e-11,
    )
    assert omnid("import", *files, "--baseline", 0.2, "--view", "direct", "-o", tmp_path / "up.toml") == 0
    assert (
        "upper ocam direct 1000x780, 0 to 138 deg from its axis, baseline 200.0 mm, upper rotated by 0.00 deg"
        in capsys.readouterr().out
    )
    (tmp_path / "folder").mkdir()
    assert omnid("export", tmp_path / "rig.toml", "--format", "ocam", "-o", tmp_path / "folder") == 0
    assert (tmp_path / "folder" / "calib_results.upper.txt").read_text() == export_ocam(ocam_rig.upper.camera)


def test_an_export_names_all_that_it_leaves_out(
    omni_rig: Rig, ocam_rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = ShutterTimes(upper_delay_s=0.01)
    direct = replace(ocam_rig.lower, camera=replace(ocam_rig.lower.camera, view="direct"))  # type: ignore[call-overload]
    write_rig(tmp_path / "omni.toml", replace(omni_rig, times=late))
    write_rig(tmp_path / "ocam.toml", replace(ocam_rig, times=late, lower=direct))
    assert omnid("export", tmp_path / "omni.toml", "--format", "kalibr", "-o", tmp_path / "k.yaml") == 0
    printed = capsys.readouterr().out
    assert "left out, because the format does not support it: " in printed and "[times]" in printed
    assert "view" not in printed
    assert omnid("export", tmp_path / "ocam.toml", "--format", "ocam", "-o", tmp_path / "o") == 0
    assert "[times], view (`calibrate import` with --view direct)" in capsys.readouterr().out


@pytest.mark.parametrize("form", ["ocam", "kalibr"])
def test_an_export_that_no_format_holds_names_the_model(omni_rig: Rig, tmp_path: Path, form: str) -> None:
    lens = DoubleSphereCamera(-0.2, 0.6, (300.0, 300.0), (384.0, 385.0), (768, 770))
    write_rig(tmp_path / "ds.toml", replace(omni_rig, lower=replace(omni_rig.lower, camera=lens)))
    with pytest.raises(CalibError, match="found one of the model ds"):
        omnid("export", tmp_path / "ds.toml", "--format", form, "-o", tmp_path / "o")


def test_invalid_requests_fail_before_files_are_written(omni_rig: Rig, ocam_rig: Rig, tmp_path: Path) -> None:
    write_rig(tmp_path / "omni.toml", omni_rig)
    write_rig(tmp_path / "ocam.toml", ocam_rig)
    (tmp_path / "k.yaml").write_text(export_kalibr(omni_rig))
    before = sorted(tmp_path.iterdir())
    cases = [
        (("import", tmp_path / "none.yaml", "-o", tmp_path / "no" / "rig.toml"), "there is no folder"),
        (("import", tmp_path / "k.yaml", "-o", tmp_path), "expected a file to write, found a folder"),
        (("import", tmp_path / "none.yaml", "-o", tmp_path / "rig.toml"), "cannot be read"),
        (("import", tmp_path / "k.yaml", "-o", tmp_path / "k.yaml"), "that is read as well"),
        (("export", tmp_path / "omni.toml", "--format", "kalibr", "-o", tmp_path / "omni.toml"), "that is read"),
        (("import", tmp_path / "k.yaml", "-o", tmp_path / "k.yaml" / "rig.toml"), "there is no folder"),
        (("import", tmp_path / "k.yaml", "--baseline", 0.2, "-o", tmp_path / "rig.toml"), "go with OCamCalib files"),
        (("import", "-o", tmp_path / "rig.toml"), "expected a Kalibr camchain.yaml, or two OCamCalib files"),
        (("import", "--lower", "a", "--upper", "b", "-o", tmp_path / "rig.toml"), "give --transform FILE or"),
        (("export", tmp_path / "omni.toml", "--format", "ocam", "-o", tmp_path / "o"), "use --format kalibr"),
        (("export", tmp_path / "ocam.toml", "--format", "kalibr", "-o", tmp_path / "k"), "use --format ocam"),
    ]
    for words, message in cases:
        with pytest.raises((CalibError, OmnidError), match=message):
            omnid(*words)
        assert sorted(tmp_path.iterdir()) == before
