"""Files of Kalibr and OCamCalib, and stitched images, as rigs; errors in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.parameters import central_names
from calib.importers import import_pair, parse_chain, parse_ocam, stacked_rig
from calib.models.camera import Array, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig_file import read_rig, write_rig
from tests.limited import run_limited

CAMERA = """
  camera_model: omni
  intrinsics: [1.0, -207.0, 208.0, 383.5, 384.5]
  distortion_model: radtan
  distortion_coeffs: [0.01, -0.02, 0.003, 0.004]
  resolution: [768, 770]
"""
# The lower camera looks up and is rotated about every axis, so that the transform differs from its inverse.
T_LOWER_IMU = se3.exp([0.01, 0.02, 0.03, 0.1, -0.2, 0.7]) @ np.diag([1, -1, -1, 1.0])
T_UPPER_LOWER = se3.exp([0.02, -0.01, 0.2, 0.02, 0.05, 0.3])


def chain(T_imu: tuple[Array | None, Array | None], T_1_0: Array | None, topics: tuple[str, str] = ("", "")) -> str:
    text = ""
    for index, (T, topic) in enumerate(zip(T_imu, topics, strict=True)):
        text += f"cam{index}:{CAMERA}" + (f"  rostopic: {topic}\n" if topic else "")
        text += f"  T_cam_imu: {T.tolist()}\n" if T is not None else ""
        text += f"  T_cn_cnm1: {T_1_0.tolist()}\n" if T_1_0 is not None and index == 1 else ""
    return text


BOTH = (T_LOWER_IMU, T_UPPER_LOWER @ T_LOWER_IMU)
NAMED = ("/lower/image_raw", "/upper/image_raw")


def test_every_number_is_parsed_as_kalibr_defines_it() -> None:
    rig = parse_chain(chain(BOTH, T_UPPER_LOWER, NAMED) + "  timeshift_cam_imu: 0.01\n")
    bent = (0.01, -0.02, 0.003, 0.004)
    assert rig.lower.camera == UnifiedCamera(1.0, (-207.0, 208.0), (383.5, 384.5), (768, 770), bent)
    np.testing.assert_array_equal(rig.lower.T_cam_rig, BOTH[0])
    np.testing.assert_array_equal(rig.upper.T_cam_rig, BOTH[1])
    assert rig.topics == NAMED and rig.times.upper_delay_s == 0.0  # the shift of one camera is no difference
    late = chain(BOTH, None, NAMED).replace("cam1:", "  timeshift_cam_imu: 0.002\ncam1:")
    assert parse_chain(late + "  timeshift_cam_imu: -0.01\n").times.upper_delay_s == pytest.approx(-0.012)


SIZE, FOCAL, CENTER = (768, 770), (225.0, 228.0), (380.0, 390.0)


@pytest.mark.parametrize(
    ("names", "intrinsics", "coefficients", "expected"),
    [
        (("ds", "none"), [-0.27, 0.55], [], DoubleSphereCamera(-0.27, 0.55, FOCAL, CENTER, SIZE)),
        (("pinhole", "equidistant"), [], [-0.012, 0.003, -0.001, 0.0002],
         EquidistantCamera((-0.012, 0.003, -0.001, 0.0002), FOCAL, CENTER, SIZE)),
        (("pinhole", "radtan"), [], [-0.1, 0.01, 0.001, 0.0002],
         UnifiedCamera(0.0, FOCAL, CENTER, SIZE, (-0.1, 0.01, 0.001, 0.0002))),
    ],
)  # fmt: skip
def test_lenses_are_imported_and_kept_in_rig_files(
    tmp_path: Path, names: tuple[str, str], intrinsics: list[float], coefficients: list[float], expected: OmniCamera
) -> None:
    camera = (
        f"  camera_model: {names[0]}\n  intrinsics: {[*intrinsics, *FOCAL, *CENTER]}\n"
        f"  distortion_model: {names[1]}\n  distortion_coeffs: {coefficients}\n  resolution: [768, 770]\n"
    )
    near = "  T_cam_imu: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, {}], [0.0, 0.0, 0.0, 1.0]]\n"
    rig = parse_chain(f"cam0:\n{camera}{near.format(0.0)}cam1:\n{camera}{near.format(-0.2)}")
    assert rig.lower.camera == rig.upper.camera == expected
    write_rig(tmp_path / "rig.toml", rig)
    assert read_rig(tmp_path / "rig.toml").upper.camera == expected
    if names != ("pinhole", "radtan"):
        with pytest.raises(CalibError, match="by Kalibr"):
            central_names(rig.lower.camera)


def warnings_of(text: str, **names: str) -> list[str]:
    lines: list[str] = []
    parse_chain(text, "c.yaml", warn=lines.append, **names)
    return lines


def test_the_lower_camera_is_known_by_name_topic_or_height() -> None:
    assert parse_chain(chain(BOTH, None), lower="cam1").upper.T_cam_rig.tolist() == BOTH[0].tolist()
    assert parse_chain(chain(BOTH, None, NAMED), upper="cam0").lower.T_cam_rig.tolist() == BOTH[1].tolist()
    np.testing.assert_array_equal(parse_chain(chain(BOTH[::-1], None)).lower.T_cam_rig, BOTH[0])
    assert warnings_of(chain(BOTH, None, NAMED)) == warnings_of(chain(BOTH, None), lower="cam0") == []
    (line,) = warnings_of(chain(BOTH, None))
    assert line.startswith("c.yaml: lower is cam0 by z of the IMU") and "--lower cam1" in line


@pytest.mark.parametrize(
    ("R_imu_rig", "off"),
    [
        (se3.rotation_exp(np.array([0.75, 0.0, 0.0])), ""),  # 43 degrees
        (se3.rotation_exp(np.array([0.0, 0.85, 0.0])), "49 deg off"),
        (np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "90 deg off"),  # z forward
    ],
)
def test_axes_of_an_imu_that_no_rig_has_give_a_warning(R_imu_rig: Array, off: str) -> None:
    T_rig_imu = se3.transform(R_imu_rig.T, np.zeros(3))
    T_upper_rig = se3.transform(np.eye(3), (0.0, 0.0, -0.2))
    text = chain((T_rig_imu, T_upper_rig @ T_rig_imu), None, NAMED)
    assert [off in line and "--frame cameras" in line for line in warnings_of(text)] == ([True] if off else [])
    assert not any("deg off" in line for line in warnings_of(text, frame="cameras"))


def test_two_of_three_cameras_are_selected_by_name() -> None:
    text = chain(BOTH, T_UPPER_LOWER, NAMED) + f"cam2:{CAMERA}  T_cn_cnm1: {T_UPPER_LOWER.tolist()}\n"
    with pytest.raises(CalibError, match="expected two cameras, found cam0, cam1, cam2"):
        parse_chain(text, lower="cam0")
    rig = parse_chain(text.replace("camera_model: omni", "camera_model: fov", 1), lower="cam1", upper="cam2")
    np.testing.assert_allclose(rig.upper.T_cam_rig, T_UPPER_LOWER @ BOTH[1], atol=1e-14)
    assert rig.topics == (NAMED[1], "")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            chain(BOTH, None).replace("camera_model: omni", "camera_model: fov"),
            "cam0: expected one of omni-radtan.*fov",
        ),
        (chain(BOTH, None).replace("0.003, 0.004]", "0.003]", 1), "cam0: expected 4 numbers .k1 k2 p1 p2., found"),
        (chain(BOTH, None).replace("[768, 770]", "768"), "cam0: .*resolution"),
        (chain(BOTH, None).replace("T_cam_imu: [[", "T_cam_imu: [[9"), "cam0.T_cam_imu: expected a rotation"),
        (chain(BOTH, None).replace("cam1:", "cam0:"), "not a YAML file"),
        (chain((None, None), None, NAMED), "no transform between cam0 and cam1"),
        (chain((BOTH[0], BOTH[0]), None), "neither topics nor heights"),
    ],
)
def test_errors_are_one_line_that_names_file_and_camera(text: str, message: str) -> None:
    with pytest.raises(CalibError, match=message) as caught:
        parse_chain(text, "c.yaml")
    assert str(caught.value).startswith("c.yaml: ") and "\n" not in str(caught.value)


def test_yaml_aliases_do_not_fill_the_memory() -> None:
    text = "a: &a [x, x]\n" + "".join(
        f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}]\n" for a, b in zip("abcdefghijk", "bcdefghijkl", strict=True)
    )
    code = f"from calib.importers import parse_chain\ntry: parse_chain({text!r})\nexcept Exception as e: print(e)"
    printed, memory_mb = run_limited(code)
    assert "no anchors and aliases" in printed and memory_mb < 200


def test_a_stereo_camera_on_its_side_needs_no_names(shared_data: Path) -> None:
    lines = list[str]()
    rig = parse_chain((shared_data / "euroc_mh01" / "camchain.yaml").read_text(), warn=lines.append)
    assert rig.baseline_m == pytest.approx(0.11, abs=1e-3) and rig.lower.T_cam_rig[2, 0] > 0.99  # x is ahead
    assert len(lines) == 1 and "by what is below in the images" in lines[0]


def test_rows_of_stitched_images_are_elevations() -> None:
    rig = stacked_rig((1920, 960), 0.191)
    assert rig.baseline_m == pytest.approx(0.191) and rig.upper.viewpoint[2] > rig.lower.viewpoint[2]
    # The top and the middle row; the middle of the image is ahead, its right is right.
    rays = rig.lower.camera.lift(np.array([[959.5, -0.5], [959.5, 479.5]]))
    np.testing.assert_allclose(rays @ rig.lower.T_cam_rig[:3, :3], [[0, 0, 1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(rig.lower.T_cam_rig[:3, :3].T @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    with pytest.raises(CalibError, match="twice as many columns as rows"):
        stacked_rig((1920, 900), 0.2)


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


def test_every_number_is_parsed_as_the_toolbox_defines_it() -> None:
    for text in (TEXT, TEXT.replace("\n", "\r\n"), TEXT.replace("480 640", "480, 640  # height, width")):
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
        ("5 -2.315000e+02", "6 -2.315000e+02", "expected lines of numbers as OCamCalib"),
        ("5 -2.315000e+02", "5 231", "with a0 < 0"),
        ("1.000529 0.000053", "1.000529 one", "could not convert"),
        ("480 640", "", "expected lines of numbers"),
    ],
)
def test_errors_of_ocam_files_are_one_line(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(CalibError, match=message) as caught:
        parse_ocam(TEXT.replace(old, new, 1), name="c.txt")
    assert str(caught.value).startswith("c.txt: ") and "\n" not in str(caught.value)


def test_two_files_are_imported_as_a_rig(tmp_path: Path) -> None:
    (tmp_path / "lower.txt").write_text(TEXT)
    (tmp_path / "upper.txt").write_text(TEXT.replace("480 640", "481 641"))
    rig = import_pair(tmp_path / "lower.txt", tmp_path / "upper.txt", T_LOWER_UPPER)
    assert (rig.lower.camera.size, rig.upper.camera.size) == ((640, 480), (641, 481))
    np.testing.assert_allclose(rig.lower.T_cam_rig @ se3.inverse(rig.upper.T_cam_rig), T_LOWER_UPPER, atol=1e-14)
    np.testing.assert_allclose(rig.upper.viewpoint, (0, 0, float(np.linalg.norm(T_LOWER_UPPER[:3, 3]))), atol=1e-14)
    # The image's u is the camera's y in this model, and the rig's x.
    assert rig.lower.T_cam_rig[1, 0] > 0.99
