"""Kalibr's camchain.yaml: import, identification of the lower camera, errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.parameters import central_names
from calib.importers import import_chain, parse_chain
from calib.models.camera import Array, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.unified import UnifiedCamera
from calib.rig_file import read_rig, write_rig

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


def test_parses_every_number_as_kalibr_defines_it() -> None:
    rig = parse_chain(chain(BOTH, T_UPPER_LOWER, NAMED))
    bent = (0.01, -0.02, 0.003, 0.004)
    assert rig.lower.camera == UnifiedCamera(1.0, (-207.0, 208.0), (383.5, 384.5), (768, 770), bent)
    np.testing.assert_array_equal(rig.lower.T_cam_rig, BOTH[0])
    np.testing.assert_array_equal(rig.upper.T_cam_rig, BOTH[1])
    assert rig.topics == NAMED


@pytest.mark.parametrize(
    ("model", "distortion", "intrinsics", "coefficients", "expected"),
    [
        (
            "ds",
            "none",
            "[-0.27, 0.55, 310.0, 315.0, 380.0, 390.0]",
            "[]",
            DoubleSphereCamera(-0.27, 0.55, (310.0, 315.0), (380.0, 390.0), (768, 770)),
        ),
        (
            "eucm",
            "none",
            "[0.63, 1.1, 240.0, 244.0, 380.0, 390.0]",
            "[]",
            ExtendedUnifiedCamera(0.63, 1.1, (240.0, 244.0), (380.0, 390.0), (768, 770)),
        ),
        (
            "pinhole",
            "equidistant",
            "[225.0, 228.0, 380.0, 390.0]",
            "[-0.012, 0.003, -0.001, 0.0002]",
            EquidistantCamera((-0.012, 0.003, -0.001, 0.0002), (225.0, 228.0), (380.0, 390.0), (768, 770)),
        ),
        (
            "pinhole",
            "radtan",
            "[225.0, 228.0, 380.0, 390.0]",
            "[-0.1, 0.01, 0.001, 0.0002]",
            UnifiedCamera(0.0, (225.0, 228.0), (380.0, 390.0), (768, 770), (-0.1, 0.01, 0.001, 0.0002)),
        ),
    ],
)
def test_reads_lenses_and_keeps_them_in_rig_files(
    tmp_path: Path, model: str, distortion: str, intrinsics: str, coefficients: str, expected: OmniCamera
) -> None:
    camera = (
        f"  camera_model: {model}\n  intrinsics: {intrinsics}\n  distortion_model: {distortion}\n"
        f"  distortion_coeffs: {coefficients}\n  resolution: [768, 770]\n"
    )
    near = "  T_cam_imu: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, {}], [0.0, 0.0, 0.0, 1.0]]\n"
    rig = parse_chain(f"cam0:\n{camera}{near.format(0.0)}cam1:\n{camera}{near.format(-0.2)}")
    assert rig.lower.camera == rig.upper.camera == expected
    write_rig(tmp_path / "rig.toml", rig)
    assert read_rig(tmp_path / "rig.toml").upper.camera == expected
    if model != "pinhole" or distortion == "equidistant":
        with pytest.raises(CalibError, match="by Kalibr"):
            central_names(rig.lower.camera)


def warnings_of(text: str, **names: str) -> list[str]:
    lines: list[str] = []
    parse_chain(text, "c.yaml", warn=lines.append, **names)
    return lines


def test_says_that_only_z_of_the_imu_tells_the_lower_camera() -> None:
    text = chain(BOTH, None)
    (line,) = warnings_of(text)
    assert line == "c.yaml: lower is cam0 by z of the IMU, which must point up; if it does not, give --lower cam1"
    assert warnings_of(text, lower="cam0") == warnings_of(chain(BOTH, None, NAMED)) == []


@pytest.mark.parametrize(
    ("R_imu_rig", "off"),
    [
        (np.eye(3), None),
        (se3.rotation_exp(np.array([0.5, 0.0, 0.0])), None),  # 29 degrees
        (se3.rotation_exp(np.array([0.0, 0.55, 0.0])), "32 deg off"),
        (np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "90 deg off"),  # z forward
        (np.diag([1.0, -1.0, -1.0]), "180 deg off"),  # z down
    ],
)
def test_warns_of_axes_of_an_imu_that_no_rig_has(R_imu_rig: Array, off: str | None) -> None:
    T_rig_imu = se3.transform(R_imu_rig.T, np.zeros(3))
    T_upper_rig = se3.transform(np.eye(3), (0.0, 0.0, -0.2))
    lines = warnings_of(chain((T_rig_imu, T_upper_rig @ T_rig_imu), None, NAMED))
    assert not lines if off is None else (len(lines) == 1 and off in lines[0] and "--frame cameras" in lines[0])


def test_uses_the_named_lower_and_upper_cameras() -> None:
    assert parse_chain(chain(BOTH, None), lower="cam1").upper.T_cam_rig.tolist() == BOTH[0].tolist()
    assert parse_chain(chain(BOTH, None, NAMED), upper="cam0").lower.T_cam_rig.tolist() == BOTH[1].tolist()
    swapped = parse_chain(chain(BOTH[::-1], None))
    np.testing.assert_array_equal(swapped.lower.T_cam_rig, BOTH[0])


def test_selects_two_of_three_cameras_by_name() -> None:
    text = chain(BOTH, T_UPPER_LOWER, NAMED) + f"cam2:{CAMERA}  T_cn_cnm1: {T_UPPER_LOWER.tolist()}\n"
    with pytest.raises(CalibError, match="expected two cameras, found cam0, cam1, cam2"):
        parse_chain(text, lower="cam0")
    rig = parse_chain(text, lower="cam0", upper="cam2")
    np.testing.assert_allclose(rig.upper.T_cam_rig, T_UPPER_LOWER @ BOTH[1], atol=1e-14)
    unused = text.replace("camera_model: omni", "camera_model: fov", 1)
    assert parse_chain(unused, lower="cam1", upper="cam2").topics == (NAMED[1], "")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("camera_model: omni", "camera_model: fov", "cam0.camera_model: expected omni.*found 'fov'"),
        ("camera_model: omni", "camera_model: pinhole", "cam0.intrinsics"),
        ("camera_model: omni", "camera_model: ds", "cam0"),
        ("distortion_model: radtan", "distortion_model: equidistant", "distortion_model: expected radtan or none"),
        ("[0.01, -0.02, 0.003, 0.004]", "[]", "cam0.distortion_coeffs: expected 4 numbers, found 0"),
        ("[1.0, -207.0, 208.0, 383.5, 384.5]", "[-207.0, 208.0, 383.5, 384.5]", "cam0.intrinsics: expected 5"),
        ("[1.0, -207.0, 208.0, 383.5, 384.5]", "[1.0, 0.0, 208.0, 383.5, 384.5]", "cam0: omni camera: expected"),
        ("[768, 770]", "768", "cam0.resolution"),
        ("cam1:", "cam0:", "not a YAML file"),
        ("cam1:", "camera1:", "expected two cameras"),
        ("T_cam_imu: [[", "T_cam_imu: [[9", "cam0.T_cam_imu: expected a rotation"),
        ("rostopic: /lower", "rostopic: [/lower]\n  x: /lower", "cam0.rostopic: expected a string"),
        ("cam0:", "- cam0:", "not a YAML file"),
        ("cam0:", "cam0: [a]\ncam2:", "cam0: expected a table"),
    ],
)
def test_errors_name_the_key(old: str, new: str, message: str) -> None:
    text = chain(BOTH, T_UPPER_LOWER, NAMED)
    assert old in text
    with pytest.raises(CalibError, match=message) as caught:
        parse_chain(text.replace(old, new, 1), "c.yaml")
    assert str(caught.value).startswith("c.yaml: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        T_UPPER_LOWER @ se3.exp([0.0015, 0, 0, 0, 0, 0]),
        T_UPPER_LOWER @ se3.exp([0, 0, 0, 0, 0.002, 0]),
    ],
)
def test_refuses_contradicting_transforms(wrong: Array) -> None:
    with pytest.raises(CalibError, match=r"cam1: T_cam_imu and T_cn_cnm1 contradict each other by"):
        parse_chain(chain(BOTH, wrong, NAMED))
    parse_chain(chain(BOTH, T_UPPER_LOWER @ se3.exp([0.0005, 0, 0, 0, 0.001, 0]), NAMED))


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (chain((None, None), None, NAMED), {}, "no transform between cam0 and cam1"),
        (chain((BOTH[0], BOTH[0]), None), {}, "neither topics nor heights"),
        (chain((BOTH[0], BOTH[0]), None, NAMED), {}, "viewpoints must lie apart"),
        (chain((BOTH[0], se3.transform(np.eye(3), [0, 0, 200.0]) @ BOTH[0]), None, NAMED), {}, "T_cam_rig in metres"),
        (chain(BOTH, None), {"lower": "cam7"}, "there is no camera cam7, found cam0, cam1"),
        (chain(BOTH, None), {"lower": "cam1", "upper": "cam1"}, "must be two cameras"),
        (f"cam0:{CAMERA}", {}, "expected two cameras .*found cam0"),
        ("", {}, "expected a YAML mapping"),
        ("[" * 3000, {}, "not a YAML file"),
        ("!!python/none x", {}, "YAML"),
    ],
)
def test_refuses_files_with_missing_information(text: str, arguments: dict[str, str], message: str) -> None:
    with pytest.raises(CalibError, match=message):
        parse_chain(text, **arguments)


def test_damaged_text_is_a_calib_error_or_a_rig() -> None:
    text, random = chain(BOTH, None, NAMED).encode(), np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(text)
        for at in random.integers(0, len(text), 3):
            damaged[at] = random.integers(0, 256)
        try:
            parse_chain(bytes(damaged[: random.integers(1, len(text) + 400)]))
        except CalibError as error:
            assert "\n" not in str(error)


def test_reads_the_file_of_a_misaligned_rig(shared_data: Path) -> None:
    rig = import_chain(shared_data / "two_walls_crooked" / "camchain.yaml")
    assert rig.baseline_m == pytest.approx(0.16, abs=1e-3)
    assert rig.upper.viewpoint[2] - rig.lower.viewpoint[2] > 0.15
