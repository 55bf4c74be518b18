"""calib_results.txt: import, errors, and the transform between two cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.importers import import_pair, parse_ocam, read_transform
from calib.models.ocam import OcamCamera

# The layout of the toolbox's own export, with own numbers.
TEXT = """#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). Used by cam2world

5 -2.315000e+02 0.000000e+00 1.540000e-03 -5.960000e-07 1.590000e-09 \n
#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

3 386.100000 298.200000 72.900000 \n
#center: "row" and "column", starting from 0 (C convention)

240.378942 318.540278

#affine parameters "c", "d", "e"

1.000529 0.000053 0.000122

#image size: "height" and "width"

480 640

"""
T_LOWER_UPPER = se3.exp([0.02, -0.01, -0.2, 0.02, 0.05, 0.3])


def test_parses_every_number_as_the_toolbox_defines_it() -> None:
    with_notes = TEXT.replace("480 640", "480, 640  # height, width").replace("318.540278", "318.540278 % centre")
    fortran = TEXT.replace("1.540000e-03", "1.54D-03").replace("5 -2.3", "5.0 -2.3").replace("#", "// ")
    for text in (TEXT, TEXT.encode(), TEXT.replace("\n", "\r\n"), with_notes, fortran):
        assert parse_ocam(text, "direct") == OcamCamera(
            (-231.5, 0.0, 1.54e-3, -5.96e-7, 1.59e-9),
            (240.378942, 318.540278),
            (1.000529, 0.000053, 0.000122),
            (640, 480),
            "direct",
        )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("5 -2.315000e+02", "6 -2.315000e+02", "line 3: expected 7 finite numbers"),
        ("5 -2.315000e+02", "x -2.315000e+02", "line 3: expected a count"),
        ("5 -2.315000e+02", "65 -2.315000e+02", "line 3: expected a count of 1 to 64"),
        ("5 -2.315000e+02", "5 nan", "line 3: expected 6 finite numbers"),
        ("5 -2.315000e+02", "5 231", "c.txt: ocam camera: expected a0 < 0"),
        ("240.378942 318.540278", "240.378942", "line 11: expected 2 finite numbers"),
        ("1.000529 0.000053", "1.000529 one", r"line 15: expected 3 finite numbers \(affine c d e\)"),
        ("480 640", "480.5 640", "line 19: expected width and height"),
        ("480 640", "0 640", "line 19"),
        ("480 640", "", "line 7: expected 2 finite numbers"),
        ("480 640", "480 640\n1", "line 15: expected 2 finite numbers"),
    ],
)
def test_errors_name_the_line(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(CalibError, match=message) as caught:
        parse_ocam(TEXT.replace(old, new, 1), name="c.txt")
    assert str(caught.value).startswith("c.txt") and "\n" not in str(caught.value)


def test_damaged_text_is_a_calib_error_or_a_camera() -> None:
    random = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(TEXT.encode())
        for at in random.integers(0, len(damaged), 4):
            damaged[at] = random.integers(0, 256)
        try:
            parse_ocam(bytes(damaged))
        except CalibError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("view", ["mirror", "direct"])
def test_imports_a_rig_from_two_files_and_a_transform(tmp_path: Path, view: str) -> None:
    (tmp_path / "lower.txt").write_text(TEXT)
    (tmp_path / "upper.txt").write_text(TEXT.replace("480 640", "481 641"))
    rig = import_pair(
        tmp_path / "lower.txt", tmp_path / "upper.txt", T_LOWER_UPPER, "mirror" if view == "mirror" else "direct"
    )
    assert (rig.lower.camera.size, rig.upper.camera.size) == ((640, 480), (641, 481))
    np.testing.assert_allclose(rig.lower.T_cam_rig @ se3.inverse(rig.upper.T_cam_rig), T_LOWER_UPPER, atol=1e-14)
    np.testing.assert_allclose(rig.upper.viewpoint, (0, 0, float(np.linalg.norm(T_LOWER_UPPER[:3, 3]))), atol=1e-14)
    # The image's u is the camera's y in this model, and the rig's x.
    assert rig.lower.T_cam_rig[1, 0] > 0.99


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.toml", f"T_lower_upper = {T_LOWER_UPPER.tolist()}"),
        ("t.toml", f"T_upper_lower = {se3.inverse(T_LOWER_UPPER).tolist()}"),
        ("t.yaml", f"T_lower_upper: {T_LOWER_UPPER.tolist()}"),
        ("t.txt", "# rows\n" + "\n".join(" ".join(map(repr, map(float, row))) for row in T_LOWER_UPPER)),
        ("t.csv", ",".join(map(repr, map(float, T_LOWER_UPPER.ravel())))),
    ],
)
def test_reads_a_transform_in_every_format(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_transform(tmp_path / name), T_LOWER_UPPER, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("t.toml", "T_x = 3", "expected either T_lower_upper or T_upper_lower, found the keys"),
        ("t.toml", "", "expected either T_lower_upper or T_upper_lower"),
        ("t.toml", "[", "expected TOML"),
        ("t.yml", "T_lower_upper: 3", "T_lower_upper: expected 12 or 16 numbers, found 3"),
        ("t.yml", "[", "YAML"),
        ("t.txt", "1 0 0 0", "the 4 rows"),
        ("t.txt", "one", "expected 16 numbers"),
        ("t.txt", "1 " * 16, "expected a rotation"),
        ("t.txt", "nan " * 16, "expected a rotation"),
    ],
)
def test_refuses_invalid_transform_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibError, match=message):
        read_transform(tmp_path / name)
