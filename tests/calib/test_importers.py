"""Files of neighbours: Kalibr, basalt, OCamCalib, ROS, OpenCV, EuRoC, camodocal, Helvipad; errors in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.parameters import central_names
from calib.importers import (
    helvipad_rig,
    import_chain,
    import_pair,
    parse_chain,
    parse_ocam,
    read_camera,
    read_transform,
    stacked_rig,
)
from calib.models.camera import Array, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.ocam import OcamCamera
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


PLAIN = chain(BOTH, None, NAMED)
PINHOLE = UnifiedCamera(0.0, (440.0, 442.0), (320.0, 240.0), (640, 480), (-0.28, 0.07, 0.0002, 0.0001))
# The upper of two cameras that look ahead, whose images' rows count down.
T_AHEAD = se3.transform(se3.rotation_exp([0.01, 0.02, 0.01]), (0.0, 0.12, 0.003))
IDENTITY = np.eye(3)
TURNED = se3.rotation_exp([0.0, 0.02, 0.01])


def rewritten(T: Array, digits: int) -> str:
    return str([[round(float(value), digits) for value in row] for row in T])


def inverses(form: Callable[[str, Array], str]) -> str:
    return "".join(
        f"cam{k}:{CAMERA}  rostopic: {topic}\n{form('T_imu_cam', se3.inverse(T))}"
        for k, (T, topic) in enumerate(zip(BOTH, NAMED, strict=True))
    )


def opencv_matrix(key: str, T: Array) -> str:
    return f"  {key}: !!opencv-matrix\n    rows: 4\n    cols: 4\n    dt: d\n    data: {T.ravel().tolist()}\n"


def yaml_matrix(key: str, T: Array) -> str:
    return f"  {key}: {T.tolist()}\n"


def as_json() -> str:
    """Return the chain as JSON, with the model's name as on Kalibr's command line."""
    camera = {
        "camera_model": "omni-radtan",
        "intrinsics": [1, -207, 208, 383.5, 384.5],
        "distortion_coeffs": [0.01, -0.02, 0.003, 0.004],
        "resolution": [768, 770],
    }
    both = enumerate(zip(BOTH, NAMED, strict=True))
    return json.dumps({f"cam{k}": {**camera, "rostopic": name, "T_cam_imu": T.tolist()} for k, (T, name) in both})


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("%YAML:1.0\n---\n" + PLAIN, ""),
        ("%YAML:1.0\n" + PLAIN, ""),
        ("%YAML 1.0\n---\n" + PLAIN, ""),
        (PLAIN.replace("omni\n", "Omni\n").replace("radtan", "RadTan") + "  timeshift_cam_imu: null\n", ""),
        ("%YAML:1.0\n---\n" + inverses(opencv_matrix), "cam0.T_imu_cam is the inverse of T_cam_imu, and is"),
        (inverses(yaml_matrix), "cam1.T_imu_cam is the inverse of T_cam_imu"),
        (PLAIN.encode("utf-8-sig"), ""),
        (PLAIN.encode("utf-16"), ""),
        (("# K\xe4lte\n" + PLAIN).encode("latin-1"), ""),
        (PLAIN.replace("\n", "\r\n"), ""),
        (PLAIN.replace("\n  ", "\n\t").replace(": ", ":\t"), ""),
        (as_json(), ""),
        (PLAIN.replace("[768, 770]", '["768", 770.0]'), ""),  # numbers as text, or with a point
        (PLAIN.replace(str(BOTH[0].tolist()), str(BOTH[0].ravel().tolist())), ""),  # a matrix as one list
        (PLAIN.replace(str(BOTH[1].tolist()), str(BOTH[1][:3].tolist())), ""),  # and without its last row
    ],
)
def test_reads_one_chain_in_every_dress(data: str | bytes, said: str) -> None:
    lines = list[str]()
    rig = parse_chain(data, "c.yaml", warn=lines.append)
    np.testing.assert_allclose(rig.lower.T_cam_rig, BOTH[0], atol=1e-12)
    np.testing.assert_allclose(rig.upper.T_cam_rig, BOTH[1], atol=1e-12)
    assert rig.topics == NAMED and rig.lower.camera == parse_chain(PLAIN).lower.camera
    assert any(said in line for line in lines) if said else not lines


@pytest.mark.parametrize("digits", [3, 4])
def test_takes_the_nearest_rotation_of_numbers_typed_with_few_digits(digits: int) -> None:
    text = PLAIN.replace(str(BOTH[1].tolist()), rewritten(BOTH[1], digits))
    (line,) = warnings_of(text)
    assert "cam1.T_cam_imu: its numbers are up to" in line and "typed with few digits" in line
    T = parse_chain(text).upper.T_cam_rig
    np.testing.assert_allclose(T, BOTH[1], atol=10.0**-digits)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_refuses_numbers_that_are_no_rotation_with_the_figure() -> None:
    with pytest.raises(CalibError, match=r"cam1.T_cam_imu: expected a rotation .*, up to 0\.00\d+ off a rotation"):
        parse_chain(PLAIN.replace(str(BOTH[1].tolist()), rewritten(BOTH[1], 2)))


def test_names_an_inverted_transform() -> None:
    with pytest.raises(CalibError, match="cam1: T_cn_cnm1 is the inverse of what T_cam_imu says"):
        parse_chain(chain(BOTH, se3.inverse(T_UPPER_LOWER), NAMED))
    lines = warnings_of(chain((None, None), se3.inverse(T_UPPER_LOWER), NAMED))
    assert len(lines) == 1 and "found below the lower one" in lines[0] and "T_cn_cnm1 is inverted" in lines[0]
    read = parse_chain(
        chain((None, None), se3.inverse(T_UPPER_LOWER), NAMED).replace("T_cn_cnm1", "T_cnm1_cn"), warn=lines.append
    )
    assert read.upper.viewpoint == pytest.approx([0, 0, 0.2012], abs=1e-4) and "is the inverse" in lines[-1]


@pytest.mark.parametrize(("T", "lower"), [(T_AHEAD, "cam0"), (se3.inverse(T_AHEAD), "cam1")])
def test_images_tell_the_lower_of_two_cameras_that_look_ahead(T: Array, lower: str) -> None:
    camera = (
        "\n  camera_model: pinhole\n  intrinsics: [225.0, 228.0, 380.0, 390.0]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.1, 0.01, 0.001, 0.0002]\n  resolution: [768, 770]\n"
    )
    lines = list[str]()
    rig = parse_chain(f"cam0:{camera}cam1:{camera}  T_cn_cnm1: {T.tolist()}\n", warn=lines.append)
    assert len(lines) == 1 and f"lower is {lower} by what is below in the images" in lines[0]
    assert rig.lower.T_cam_rig[2, 0] > 0.99, "x of the rig is ahead, along the optical axes"
    assert rig.lower.T_cam_rig[0, 1] < -0.99, "y is to the left"


def test_an_imu_whose_axes_are_no_rigs_is_left_out_where_asked() -> None:
    T_imu = se3.transform(se3.rotation_exp([0.0, np.pi / 2, 0.0]), (0.1, 0.2, 0.3))
    text = chain((BOTH[0] @ T_imu, BOTH[1] @ T_imu), None, NAMED)
    rig = parse_chain(text, frame="cameras")
    assert rig.upper.viewpoint == pytest.approx([0, 0, rig.baseline_m], abs=1e-12)


def basalt(kind: str, **numbers: float) -> str:
    def pose(T: Array) -> dict[str, float]:
        values = [*T[:3, 3].tolist(), *se3.quaternion(T[:3, :3]).tolist()]
        return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), values, strict=True))

    lens = {"camera_type": kind, "intrinsics": {"fx": 310.0, "fy": 315.0, "cx": 380.0, "cy": 390.0, **numbers}}
    value = {
        "T_imu_cam": [pose(se3.inverse(T)) for T in BOTH],
        "intrinsics": [lens, lens],
        "resolution": [[768, 770]] * 2,
        "cam_time_offset_ns": 0,
        "vignette": [],
    }
    return json.dumps({"value0": value})


FOCAL, CENTER, SIZE = (310.0, 315.0), (380.0, 390.0), (768, 770)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (basalt("ds", xi=-0.27, alpha=0.55), DoubleSphereCamera(-0.27, 0.55, FOCAL, CENTER, SIZE)),
        (basalt("eucm", alpha=0.6, beta=1.1), ExtendedUnifiedCamera(0.6, 1.1, FOCAL, CENTER, SIZE)),
        (basalt("ucm", alpha=0.6), ExtendedUnifiedCamera(0.6, 1.0, FOCAL, CENTER, SIZE)),
        (basalt("kb4", k1=0.01, k2=0.0, k3=0.0, k4=0.0), EquidistantCamera((0.01, 0, 0, 0), FOCAL, CENTER, SIZE)),
        (
            basalt("pinhole-radtan8", k1=-0.1, k2=0.01, p1=0.001, p2=0.002, k3=0, k4=0, k5=0, k6=0, rpmax=2),
            UnifiedCamera(0.0, FOCAL, CENTER, SIZE, (-0.1, 0.01, 0.001, 0.002)),
        ),
    ],
)
def test_reads_basalts_calibration(text: str, expected: OmniCamera) -> None:
    rig = parse_chain(text, "c.json")
    assert rig.lower.camera == rig.upper.camera == expected
    assert parse_chain(json.dumps(json.loads(text)["value0"])).lower.camera == expected, "also without its wrapper"
    np.testing.assert_allclose(rig.upper.T_cam_rig, BOTH[1], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (basalt("bal"), "camera_type: expected ds, eucm, ucm, .* found 'bal'"),
        (basalt("ds", xi=-0.27), "expected the number 'alpha' of its model"),
        ('{"value0": {"T_imu_cam": []}}', "expected basalt's calibration with T_imu_cam, intrinsics and resolution"),
        ("<?xml version='1.0'?>\n<opencv_storage></opencv_storage>", "it is XML: write it as .yml, with OpenCV's"),
        ("", "expected a YAML mapping, found nothing"),
        ("Camera1.fx: 190.9\nCamera1.fy: 190.9\n", r"found \['Camera1.fx', 'Camera1.fy'\]; files of one camera each"),
    ],
)
def test_refuses_other_chains_in_one_line(text: str, message: str) -> None:
    with pytest.raises(CalibError, match=message) as caught:
        parse_chain(text, "c")
    assert "\n" not in str(caught.value)


def matrix(rows: int, columns: int, data: Array | list[float]) -> dict[str, object]:
    return {"rows": rows, "cols": columns, "data": np.ravel(data).tolist()}


def camera_info(model: str, terms: list[float], at_m: float = 0.0, R: Array = IDENTITY) -> dict[str, object]:
    """Return camera_info of a camera at_m above the first one of a rectified pair."""
    return {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "stereo/lower",
        "camera_matrix": matrix(3, 3, [440.0, 0, 320, 0, 442, 240, 0, 0, 1]),
        "distortion_model": model,
        "distortion_coefficients": matrix(1, len(terms), terms),
        "rectification_matrix": matrix(3, 3, R),
        "projection_matrix": matrix(3, 4, [430.0, 0, 320, 0, 0, 430, 240, 430 * at_m, 0, 0, 1, 0]),
    }


def message(info: dict[str, object]) -> dict[str, object]:
    """Return camera_info as a message of ROS 2."""
    names = {"image_width": "width", "image_height": "height", "distortion_coefficients": "d", "camera_matrix": "k"}
    names |= {"rectification_matrix": "r", "projection_matrix": "p", "distortion_model": "distortion_model"}
    return {new: one["data"] if isinstance(one := info[old], dict) else one for old, new in names.items()}


RADTAN = [-0.28, 0.07, 0.0002, 0.0001]
K_OPENCV = "!!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [440., 0., 320., 0., 442., 240., 0., 0., 1.]\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.yaml", json.dumps(camera_info("plumb_bob", [*RADTAN, 0.0])), PINHOLE),
        ("a.json", json.dumps(message(camera_info("plumb_bob", [*RADTAN, 0.0]))), PINHOLE),
        ("a.yaml", json.dumps(message(camera_info("rational_polynomial", [*RADTAN, 0, 0, 0, 0]))) + "\n---\n", PINHOLE),
        ("a.yaml", json.dumps({"camera": {"ros__parameters": camera_info("plumb_bob", [*RADTAN, 0.0])}}), PINHOLE),
        ("a.yaml", json.dumps({key.title(): one for key, one in camera_info("plumb_bob", RADTAN).items()}), PINHOLE),
        ("a.yaml", json.dumps(camera_info("equidistant", [0.01, 0, 0, 0])), EquidistantCamera(
            (0.01, 0, 0, 0), (440.0, 442.0), (320.0, 240.0), (640, 480))),
        ("a.yaml", "# polynomial\n3 -200 0 0.001\n240 320\n1 0 0\n480 640\n", OcamCamera(
            (-200.0, 0.0, 0.001), (240.0, 320.0), (1.0, 0.0, 0.0), (640, 480), "mirror")),
        ("a.yml", f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: {K_OPENCV}"
         f"distortion_coefficients: !!opencv-matrix\n  rows: 4\n  cols: 1\n  dt: d\n  data: {RADTAN}\n", PINHOLE),
        ("a.yaml", "camera_model: pinhole\nintrinsics: [440, 442, 320, 240]\ndistortion_model: radial-tangential\n"
         f"distortion_coefficients: {RADTAN}\nresolution: [640, 480]\nT_BS:\n  cols: 4\n  rows: 4\n"
         f"  data: {np.eye(4).ravel().tolist()}\n", PINHOLE),
        ("a.yaml", "%YAML:1.0\n---\nmodel_type: MEI\nimage_width: 640\nimage_height: 480\nmirror_parameters:\n"
         "  xi: 1.5\ndistortion_parameters:\n  k1: 0.1\n  k2: 0.2\n  p1: 0.0\n  p2: 0.0\nprojection_parameters:\n"
         "  gamma1: 500.0\n  gamma2: 501.0\n  u0: 320.0\n  v0: 240.0\n",
         UnifiedCamera(1.5, (500.0, 501.0), (320.0, 240.0), (640, 480), (0.1, 0.2, 0.0, 0.0))),
        ("a.yaml", "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\nimage_width: 640\nimage_height: 480\n"
         "projection_parameters:\n  k2: 0.01\n  k3: 0.0\n  k4: 0.0\n  k5: 0.0\n  mu: 200.0\n  mv: 201.0\n  u0: 320.0\n"
         "  v0: 240.0\n", EquidistantCamera((0.01, 0, 0, 0), (200.0, 201.0), (320.0, 240.0), (640, 480))),
    ],
)  # fmt: skip
def test_reads_files_of_one_camera(name: str, text: str, expected: OmniCamera, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert read_camera(tmp_path / name)[0] == expected


def test_a_rectified_pair_tells_the_transform(tmp_path: Path) -> None:
    for name, at_m in (("lower.yaml", 0.0), ("upper.yaml", 0.12)):
        (tmp_path / name).write_text(json.dumps(camera_info("plumb_bob", [*RADTAN, 0], at_m, TURNED)))
    rig = import_pair(tmp_path / "lower.yaml", tmp_path / "upper.yaml", None)
    np.testing.assert_allclose(rig.upper.viewpoint, [0, 0, 0.12], atol=1e-12)
    assert rig.lower.T_cam_rig[2, 0] > 0.99, "x of the rig is ahead"
    assert rig.lower.T_cam_rig[1, 2] < -0.99, "the upper camera is where the rows of the image begin"
    lines = list[str]()
    import_pair(tmp_path / "upper.yaml", tmp_path / "lower.yaml", None, warn=lines.append)
    assert len(lines) == 1 and "found below the lower one" in lines[0]
    beside = camera_info("plumb_bob", [*RADTAN, 0])
    beside["projection_matrix"] = matrix(3, 4, [430.0, 0, 320, -51.6, 0, 430, 240, 0, 0, 0, 1, 0])
    (tmp_path / "right.yaml").write_text(json.dumps(beside))
    import_pair(tmp_path / "lower.yaml", tmp_path / "right.yaml", None, warn=lines.append)
    assert len(lines) == 2 and "the cameras are found side by side" in lines[1]
    (tmp_path / "alone.yaml").write_text(json.dumps(camera_info("plumb_bob", [*RADTAN, 0])))
    with pytest.raises(CalibError, match="give --transform FILE or --baseline METRES"):
        import_pair(tmp_path / "alone.yaml", tmp_path / "alone.yaml", None)


@pytest.mark.parametrize(
    ("terms", "most_px"),
    [([*RADTAN, 0.02], 0.1), ([0.2, 0.05, 0.0002, 0.0001, 0.001, 0.5, 0.1, 0.01], 0.2)],
)
def test_distortion_without_an_equal_is_fitted_and_its_error_told(
    terms: list[float], most_px: float, tmp_path: Path
) -> None:
    path, lines = tmp_path / "a.yaml", list[str]()
    path.write_text(json.dumps(camera_info("rational_polynomial" if len(terms) > 5 else "plumb_bob", terms)))
    camera, _ = read_camera(path, warn=lines.append)
    assert len(lines) == 1 and "is read as the nearest omni camera, off by" in lines[0]
    # The same rays by OpenCV's equation, within the image.
    k1, k2, p1, p2, k3, k4, k5, k6 = [*terms, 0, 0, 0, 0][:8]
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.45, 0.45, 9))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = 440 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 320
    v = 442 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 240
    found = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3))
    assert np.abs(found - np.stack([u, v], axis=-1).reshape(-1, 2)).max() < most_px


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps(camera_info("thin_prism", [0.0] * 4)), "distortion_model: expected .*found 'thin_prism'"),
        (json.dumps(camera_info("plumb_bob", [0.1, 0.2])), "distortion_coefficients: expected 0 or 4 or 5"),
        (json.dumps(camera_info("rational_polynomial", [-0.9, 0.9, 0, 0, -0.1, 0.5, -0.5, 0.9])), "px off: calibrate"),
        ("model_type: SCARAMUZZA\n", "import the calib_results.txt of OCamCalib"),
        ("M1: [1]\nD1: [2]\n", r"expected one camera as ROS's camera_info.*found the keys \['D1', 'M1'\]"),
    ],
)
def test_refuses_other_files_of_one_camera_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(CalibError, match=message) as caught:
        read_camera(tmp_path / "a.yaml")
    assert str(caught.value).startswith(str(tmp_path)) and "\n" not in str(caught.value)


# As the data set has it: centimetres, and numbers of the lidar and of the lenses, which are not used.
HELVIPAD = {
    "stereo_baseline": 19.1,
    "lidar_camera_baseline": 45.0,
    "intrinsic_parameters": {"K": [[855.9, 0, 1451.2], [0, 852.77, 1451.71], [0, 0, 1]], "D": [0, 0, 0, 0]},
}


def test_rows_of_helvipad_have_the_angles_that_its_authors_compute_with() -> None:
    """Row r of the 512 lies at (1535 - 2 r) / 1920 of half a turn from the nadir; the baseline is 19.1 cm."""
    rig = helvipad_rig(HELVIPAD, "calibration.json")
    assert rig.baseline_m == pytest.approx(0.191) and rig.upper.viewpoint[2] > rig.lower.viewpoint[2]
    rows = np.array([0.0, 200, 511])
    rays = rig.lower.camera.lift(np.column_stack([np.full(3, 959.5), rows]))
    from_nadir = np.arccos(rays[:, 1])
    np.testing.assert_allclose(np.rad2deg(from_nadir), (1535 - 2 * rows) / 1920 * 180, atol=0.1)
    # The middle of the image is ahead, its right is right.
    np.testing.assert_allclose(rig.lower.T_cam_rig[:3, :3].T @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rig.lower.T_cam_rig[:3, :3].T @ [1, 0, 0], [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({}, "stereo_baseline"),
        ({"stereo_baseline": "19"}, "stereo_baseline"),
        ({"stereo_baseline": 1910}, "expected 0.001 to 5.0 m"),
        ({"stereo_baseline": float("nan")}, "expected 0.001 to 5.0 m"),
    ],
)
def test_other_files_are_refused(values: dict[str, object], found: str) -> None:
    with pytest.raises(CalibError, match=found):
        helvipad_rig(values, "calibration.json")


def test_images_of_other_sizes_are_refused() -> None:
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
