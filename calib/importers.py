"""Calibrations of other programs as rigs of omnid.

- Chains of cameras: Kalibr's `camchain.yaml` (p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0, t_imu = t_cam +
  timeshift_cam_imu; T_cam_imu is taken for T_cam_rig) and basalt's `calibration.json`.
- Files of one camera each: OCamCalib, ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal (VINS). The transform
  between two is in them (EuRoC's T_BS, the rectification of a stereo camera_info), or it has a file, or it is straight
  up.
- Stitched images of two 360-degree cameras: by their baseline, or of the data set Helvipad (Zayene et al. 2025), whose
  images are the rows 192 to 703 of stitched images of 1920x960, and whose calibration.json has `stereo_baseline` [cm].
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from msgspec import Struct

from calib import se3
from calib.errors import CalibError, within
from calib.foreign_models import camera_of_lists, camera_of_names
from calib.models.camera import Array, OmniCamera
from calib.models.lens import full_turn
from calib.models.names import sees_directly
from calib.models.ocam import MAX_COEFFICIENTS, OcamCamera, View
from calib.models.unified import UnifiedCamera
from calib.rig import (
    MAX_BASELINE_M,
    MIN_BASELINE_M,
    MountedCamera,
    Rig,
    ShutterTimes,
    is_turned_over,
    mounting_notes,
    rig_between,
)
from calib.typed_toml import convert, shown, table_of
from calib.validation import (
    MAX_BYTES,
    MAX_JSON_BYTES,
    Warn,
    decode,
    load_mapping,
    read_bytes,
    require_image_size,
    silent,
    transform_of,
)

# Tolerance between two transforms that a file states: more than rounding, less than any real difference of two rigs.
MAX_DISAGREEMENT_M, MAX_DISAGREEMENT_RAD = 1e-3, np.deg2rad(0.1)
# Largest angle of the baseline from z of the rig, because no rig leans so far, but the axes of an IMU may be others.
MAX_LEAN_RAD: Final = np.deg2rad(30)
MIN_DELAY_S: Final = 0.5e-3  # between two cameras: less is no different from none, as for `omnid calibrate drive`
LOWER_WORDS, UPPER_WORDS = {"lower", "bottom"}, {"upper", "top"}
# Keys of the inverse of a transform, which neighbours write instead: OpenVINS, VINS.
INVERSES: Final = {
    "T_cam_imu": "T_imu_cam",
    "T_cn_cnm1": "T_cnm1_cn",
    "T_lower_upper": "T_upper_lower",
}
# Keys of one thing, in camera_info YAML, in messages of ROS 1 and of ROS 2.
MATRIX: Final = ("camera_matrix", "K", "k", "Camera_Matrix")
TERMS: Final = ("distortion_coefficients", "D", "d", "distortion_coeffs", "Distortion_Coefficients")
RECTIFICATION, PROJECTION = ("rectification_matrix", "R", "r"), ("projection_matrix", "P", "p")
WIDTH: Final = ("image_width", "width", "image_Width")
HEIGHT: Final = ("image_height", "height", "image_Height")
# Size of the images of Helvipad, and their first row in the whole image.
HELVIPAD_SIZE, HELVIPAD_TOP_PX = (1920, 512), 192
Matrix: TypeAlias = tuple[tuple[float, ...], ...]


# 1. Chains of cameras.
class ChainCamera(Struct, frozen=True):
    """One camera of a chain, with the keys that matter here."""

    camera_model: str = ""
    intrinsics: tuple[float, ...] = ()
    distortion_model: str = ""
    distortion_coeffs: tuple[float, ...] = ()
    resolution: tuple[int, int] = (0, 0)
    rostopic: str = ""
    timeshift_cam_imu: float | None = None
    T_cam_imu: Matrix | None = None
    T_cn_cnm1: Matrix | None = None
    T_imu_cam: Matrix | None = None
    T_cnm1_cn: Matrix | None = None
    basalt: tuple[str, dict[str, float]] | None = None  # model and numbers, instead of Kalibr's


def import_chain(path: Path, lower: str = "", upper: str = "", frame: str = "imu", warn: Warn = silent) -> Rig:
    """Read the rig of a file of several cameras; lower and upper: names of cameras (cam0), instead of topic or height.

    frame: "imu": T_cam_imu is taken for T_cam_rig; "cameras": the rig frame is that of rig_between.
    """
    return parse_chain(read_bytes(path, MAX_JSON_BYTES), str(path), lower, upper, frame, warn)


def parse_chain(
    text: str | bytes,
    name: str = "camchain.yaml",
    lower: str = "",
    upper: str = "",
    frame: str = "imu",
    warn: Warn = silent,
) -> Rig:
    """Parse the rig of a file's text; warn: takes lines about what had to be assumed."""
    with within(f"{name}: "):
        cameras = _chain_cameras(load_mapping(text, name))
        return _chain_rig(cameras, (lower, upper), frame, lambda line: warn(f"{name}: {line}"))


def _chain_rig(cameras: Mapping[str, ChainCamera], named: tuple[str, str], frame: str, warn: Warn) -> Rig:
    # 1. The poses of the cameras, and which of them is lower.
    poses, has_rig_frame = _chain_poses(cameras, warn)
    low, up = _lower_and_upper(cameras, named, poses, warn, has_rig_frame=has_rig_frame)
    if not {low, up} <= poses.keys():
        raise CalibError(f"no transform between {low} and {up}; expected T_cam_imu of both, or T_cn_cnm1")
    # 2. Their models. Nothing in the file tells lenses from mirrors whose images were flipped.
    models = [_chain_model(key, cameras[key], warn) for key in (low, up)]
    if any(isinstance(camera, UnifiedCamera) and camera.xi > 0 and sees_directly(camera) for camera in models):
        warn(
            "its omni cameras count as lenses, by their focal lengths; if these are mirrors whose images were "
            "flipped, give them masks in the rig.toml"
        )
    # 3. The rig, in the axes of the IMU or in those of its cameras.
    topics = (cameras[low].rostopic, cameras[up].rostopic)
    if has_rig_frame and frame == "imu":
        rig = Rig(MountedCamera(models[0], poses[low]), MountedCamera(models[1], poses[up]), topics=topics)
        x, y, z = rig.upper.viewpoint - rig.lower.viewpoint
        lean_rad = np.arctan2(np.hypot(x, y), z)
        if lean_rad > MAX_LEAN_RAD:
            warn(
                "expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
                f"{np.rad2deg(lean_rad):.0f} deg off: give --frame cameras, by which the rig frame follows from the "
                "cameras, or add T_base_rig to the rig"
            )
    else:
        rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), topics)
        for note in mounting_notes(rig):
            warn(f"{note} (or T_cn_cnm1 is inverted: write it as T_cnm1_cn)" if is_turned_over(rig) else note)
    # 4. The delay of the upper camera: the difference of both cameras' shifts against the IMU's clock.
    shifts = cameras[low].timeshift_cam_imu, cameras[up].timeshift_cam_imu
    delay_s = 0.0 if shifts[0] is None or shifts[1] is None else shifts[1] - shifts[0]
    with within("timeshift_cam_imu: "):
        return replace(rig, times=ShutterTimes(delay_s if abs(delay_s) >= MIN_DELAY_S else 0.0))


def _chain_cameras(values: Mapping[str, Any]) -> dict[str, ChainCamera]:
    """Return cam0, cam1, ... in ascending order."""
    values = values.get("value0", values)
    if not isinstance(values, Mapping) or "T_imu_cam" in values:
        return _basalt_cameras(values)
    names = [key for key in values if re.fullmatch(r"cam\d{1,3}", key)]
    if len(names) < 2:
        others = shown(sorted(values)) if values else "none"
        raise CalibError(
            f"expected two cameras (cam0, cam1), found {', '.join(names) or others}; files of one camera each are "
            "given as --lower and --upper"
        )
    found, known = dict[str, ChainCamera](), ChainCamera.__struct_fields__
    for key in sorted(names, key=lambda key: int(key[3:])):
        if not isinstance(values[key], Mapping):
            raise CalibError(f"{key}: expected a table, found {shown(values[key])}")
        found[key] = convert(
            ChainCamera, {name: values[key][name] for name in known if values[key].get(name) is not None}, (key,)
        )
    return found


def _basalt_cameras(value: Any) -> dict[str, ChainCamera]:
    """Return the cameras of basalt's calibration: p_imu = T_imu_cam p_cam, as a position and a quaternion."""
    try:
        found = {}
        parts = zip(value["T_imu_cam"], value["intrinsics"], value["resolution"], strict=True)
        for number, (pose, lens, (width, height)) in enumerate(parts):
            R = se3.rotation([pose[key] for key in ("qx", "qy", "qz", "qw")])
            T_cam_imu = se3.inverse(se3.transform(R, [pose[key] for key in ("px", "py", "pz")]))
            found[f"cam{number}"] = ChainCamera(
                resolution=(int(width), int(height)),
                T_cam_imu=tuple(tuple(row) for row in T_cam_imu.tolist()),
                basalt=(str(lens["camera_type"]), {key: float(v) for key, v in lens["intrinsics"].items()}),
            )
        return found
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibError(
            f"expected basalt's calibration with T_imu_cam, intrinsics and resolution of each camera: {error!r}"
        ) from error


def _chain_model(key: str, camera: ChainCamera, warn: Warn) -> OmniCamera:
    """Return a camera of any model that foreign_models.py knows."""

    names, size = (camera.camera_model, camera.distortion_model), camera.resolution
    try:
        if camera.basalt is not None:
            return camera_of_names("camera_type", *camera.basalt, size, lambda line: warn(f"{key}: {line}"))
        numbers = camera.intrinsics, camera.distortion_coeffs
        return camera_of_lists(names, *numbers, size, lambda line: warn(f"{key}: {line}"))
    except CalibError as error:
        dot = "." if re.match(r"[a-z_]+: ", str(error)) else ": "
        raise CalibError(f"{key}{dot}{error}") from error


def _chain_poses(cameras: Mapping[str, ChainCamera], warn: Warn) -> tuple[dict[str, Array], bool]:
    """Return transforms from one common frame into each camera; True if that frame is the rig's, False if cam0's."""
    own = {key: _stated(camera, "T_cam_imu", key, warn) for key, camera in cameras.items()}
    poses = {key: T for key, T in own.items() if T is not None}
    has_rig_frame = bool(poses)
    if not has_rig_frame:
        poses[next(iter(cameras))] = np.eye(4)
    for before, key in pairwise(cameras):
        T_key_before = _stated(cameras[key], "T_cn_cnm1", key, warn)
        if T_key_before is None or int(key[3:]) != int(before[3:]) + 1:
            continue
        if before in poses and key in poses:
            _require_consistency(key, poses[key] @ se3.inverse(poses[before]), T_key_before, ("T_cam_imu", "T_cn_cnm1"))
        elif before in poses:
            poses[key] = T_key_before @ poses[before]
        elif key in poses:
            poses[before] = se3.inverse(T_key_before) @ poses[key]
    return poses, has_rig_frame


def _stated(table: Struct, key: str, place: str, warn: Warn) -> Array | None:
    """Return the transform of a key of INVERSES, from its own key or that of its inverse; None without both."""
    own, other = (
        None if (rows := getattr(table, name)) is None else transform_of(rows, f"{place}.{name}", warn)
        for name in (key, INVERSES[key])
    )
    if own is not None and other is not None:
        _require_consistency(place, own, se3.inverse(other), (key, INVERSES[key]))
    if own is not None or other is None:
        return own
    warn(f"{place}.{INVERSES[key]} is the inverse of {key}, and is read as that")
    return se3.inverse(other)


def _require_consistency(camera: str, one: Array, other: Array, keys: tuple[str, str]) -> None:
    """Raise CalibError for transforms that differ, and say so where one is the inverse of the other."""
    gaps = [se3.log(se3.inverse(one) @ T) for T in (other, se3.inverse(other))]
    (distance_m, angle_rad), inverted = (np.linalg.norm(gap.reshape(2, -1), axis=1) for gap in gaps)
    if distance_m <= MAX_DISAGREEMENT_M and angle_rad <= MAX_DISAGREEMENT_RAD:
        return
    if inverted[0] <= MAX_DISAGREEMENT_M and inverted[1] <= MAX_DISAGREEMENT_RAD:
        raise CalibError(f"{camera}: {keys[1]} is the inverse of what {keys[0]} says: invert it, or name it T_cnm1_cn")
    raise CalibError(
        f"{camera}: {keys[0]} and {keys[1]} contradict each other by {distance_m * 1e3:.1f} mm and "
        f"{np.rad2deg(angle_rad):.2f} deg; remove the one that is wrong"
    )


def _lower_and_upper(
    cameras: Mapping[str, ChainCamera],
    named: tuple[str, str],
    poses: Mapping[str, Array],
    warn: Warn,
    *,
    has_rig_frame: bool,
) -> tuple[str, str]:
    """Return the names of the lower and the upper camera: as named, else by topic, else by height in the rig frame, or
    by what is below in their images.
    """
    names = list(cameras)
    for name in filter(None, named):
        if name not in names:
            raise CalibError(f"there is no camera {name}, found {', '.join(names)}")
    if len(names) > 2 and not all(named):
        raise CalibError(f"expected two cameras, found {', '.join(names)}; give --lower and --upper")
    if any(named):
        other = [name for name in names if name not in named]
        low, up = named[0] or other[0], named[1] or other[0]
        if low == up:
            raise CalibError(f"lower and upper must be two cameras, found {low} for both")
        return low, up
    # 1. By the words of the topics.
    words = [set(re.split(r"[^a-z]+", camera.rostopic.lower())) for camera in cameras.values()]
    first, second = (bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words)
    if first != second:
        return (names[0], names[1]) if first > second else (names[1], names[0])
    # 2. By height, or by the order in which the upper camera is not below the lower one in the images.
    orders = [(names[0], names[1]), (names[1], names[0])] if len(poses) == 2 else []
    if has_rig_frame:
        heights = {name: float(se3.inverse(T)[2, 3]) for name, T in poses.items()}
        orders = [(low, up) for low, up in orders if heights[up] - heights[low] >= MAX_DISAGREEMENT_M]
    else:
        models = {name: _chain_model(name, cameras[name], silent) for name in names}
        rigs = {(a, b): rig_between(models[a], models[b], poses[a] @ se3.inverse(poses[b])) for a, b in orders}
        orders = [order for order, rig in rigs.items() if not is_turned_over(rig)]
    if len(orders) != 1:
        raise CalibError(
            f"neither topics nor heights identify the lower camera; name it, --lower {names[0]} or --lower {names[1]}"
        )
    ((low, up),) = orders
    if has_rig_frame:
        warn(f"lower is {low} by z of the IMU, which must point up; if it does not, give --lower {up}")
    else:
        warn(f"lower is {low} by what is below in the images; if the cameras stand upside down, give --lower {up}")
    return low, up


# 2. Files of one camera each.
@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera, and where it is: T_body_cam, or T_stereo_cam of a rectified pair; None where the file does not tell."""

    camera: OmniCamera
    T_body_cam: Array | None = None  # (4, 4)


def import_pair(
    lower_path: Path, upper_path: Path, T_lower_upper: Array | None, view: View = "mirror", warn: Warn = silent
) -> Rig:
    """Read the rig of two files of one camera each; its frame is the lower viewpoint's, see rig_between.

    T_lower_upper: None if the files tell it.
    """
    lower, upper = (read_camera(path, view, warn) for path in (lower_path, upper_path))
    if T_lower_upper is None and lower.T_body_cam is not None and upper.T_body_cam is not None:
        T_lower_upper = se3.inverse(lower.T_body_cam) @ upper.T_body_cam
    if T_lower_upper is None or not se3.t_of(T_lower_upper).any():
        raise CalibError(
            f"{lower_path} and {upper_path} do not contain the transform between the cameras: give --transform FILE or "
            "--baseline METRES"
        )
    rig = rig_between(lower.camera, upper.camera, T_lower_upper)
    for note in mounting_notes(rig):
        warn(note)
    return rig


def read_camera(path: Path, view: View = "mirror", warn: Warn = silent) -> CameraFile:
    """Read the file of one camera, of any of these programs, told by its content. view: of OCamCalib's."""
    data, name = read_bytes(path, MAX_JSON_BYTES), str(path)
    is_named = path.suffix.lower() in (".yaml", ".yml", ".json", ".xml")
    first = next((words for _, words in _word_lines(data, name)), ["", ""])
    if not is_named or (first[0].isdigit() and len(first) > 1):
        return CameraFile(parse_ocam(data, view, name))
    values = load_mapping(data, name)
    read = _reader(values)
    if read is None:
        raise CalibError(
            f"{name}: expected one camera as ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal or OCamCalib "
            f"write it, found the keys {shown(sorted(values))}"
        )
    with within(f"{name}: "):
        return read(values, lambda line: warn(f"{name}: {line}"))


def is_one_camera(values: Mapping[str, Any]) -> bool:
    """True for the values of a file of one camera."""
    return _reader(values) is not None


def _reader(values: Mapping[str, Any]) -> Callable[[Mapping[str, Any], Warn], CameraFile] | None:
    """Return the function that reads the values of one camera, by their keys; None for others."""
    if any(key in values for key in MATRIX) and any(key in values for key in TERMS):
        return _camera_info
    if "model_type" in values:
        return _camodocal
    return _euroc if "T_BS" in values else None


def _camera_info(values: Mapping[str, Any], warn: Warn) -> CameraFile:
    """Return the camera of camera_info, in YAML or as a message, and of OpenCV's calibration sample."""
    K, terms = _numbers(values, MATRIX, (9,)), _numbers(values, TERMS, (0, 4, 5, 8, 12, 14))
    model = str(values.get("distortion_model", "plumb_bob") or "plumb_bob")
    if values.get("fisheye_model"):  # of OpenCV's sample
        model = "fisheye"
    camera = camera_of_lists(("pinhole", model), [K[0], K[4], K[2], K[5]], terms.tolist(), _size(values), warn)
    if not any(key in values for key in PROJECTION):
        return CameraFile(camera)
    R, P = _numbers(values, RECTIFICATION, (9,)).reshape(3, 3), _numbers(values, PROJECTION, (12,)).reshape(3, 4)
    if not (P[0, 0] and P[1, 1] and R.any()):  # of a camera that is not calibrated as one of two
        return CameraFile(camera)
    # A point R p_cam of the rectified pair is seen at P = K' [I | t].
    t = np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0])
    return CameraFile(camera, transform_of(se3.transform(R, -t).tolist(), "R", warn))


def _euroc(values: Mapping[str, Any], warn: Warn) -> CameraFile:
    """Return the camera of EuRoC's sensor.yaml; p_body = T_BS p_cam."""
    names = str(values.get("camera_model", "")), str(values.get("distortion_model", ""))
    width, height = _numbers(values, ("resolution",), (2,))
    intrinsics = _numbers(values, ("intrinsics",), tuple(range(4, 7))).tolist()
    terms = _numbers(values, TERMS, tuple(range(15))).tolist()
    camera = camera_of_lists(names, intrinsics, terms, (int(width), int(height)), warn)
    return CameraFile(camera, transform_of(values["T_BS"], "T_BS", warn))


def _camodocal(values: Mapping[str, Any], warn: Warn) -> CameraFile:
    """Return the camera of a file of camodocal, as VINS-Mono and VINS-Fusion use it."""
    found = dict[str, float]()
    for table in ("mirror_parameters", "distortion_parameters", "projection_parameters"):
        part = values.get(table)
        found |= {str(key): float(value) for key, value in (part if isinstance(part, Mapping) else {}).items()}
    kind = str(values["model_type"]).upper()
    if kind == "SCARAMUZZA":
        raise CalibError("model_type: of SCARAMUZZA, import the calib_results.txt of OCamCalib")
    return CameraFile(camera_of_names("model_type", kind, found, _size(values), warn))


def _size(values: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height of the images."""
    return int(_numbers(values, WIDTH, (1,))[0]), int(_numbers(values, HEIGHT, (1,))[0])


def _numbers(values: Mapping[str, Any], keys: tuple[str, ...], counts: tuple[int, ...]) -> Array:
    """Return the finite numbers (N,) under the first of several keys that is there."""
    key = next((key for key in keys if key in values), keys[0])
    try:
        found = np.array(values.get(key) if values.get(key) is not None else [], float).ravel()
    except (TypeError, ValueError):
        found = np.array([np.nan])
    if not np.isfinite(found).all() or len(found) not in counts:
        expected = " or ".join(map(str, counts))
        raise CalibError(f"{key}: expected {expected} numbers, found {shown(values.get(key))}")
    return found


# 3. OCamCalib's `calib_results.txt`, and the transform between two cameras.
def parse_ocam(text: str | bytes, view: View = "mirror", name: str = "calib_results.txt") -> OcamCamera:
    """Parse the camera of a calib_results.txt's text; the inverse polynomial, of any length, is not used."""
    if len(text) > MAX_BYTES:
        raise CalibError(f"{name}: expected at most {MAX_BYTES} bytes, found {len(text)}")
    lines = _word_lines(text, name)
    if len(lines) < 4:
        raise CalibError(
            f"{name}: expected lines of numbers (polynomial, inverse polynomial, centre, affine, image size), found "
            f"{len(lines)}"
        )

    def expected(at: int, what: str) -> CalibError:
        number, words = lines[at]
        return CalibError(f"{name}, line {number}: expected {what}, found {shown(' '.join(words))}")

    def numbers(at: int, what: str, count: int) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in lines[at][1])
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            raise expected(at, f"{count} finite numbers ({what})")
        return values

    lead = lines[0][1][0]
    count = int(lead) if lead.isascii() and lead.isdigit() and len(lead) < 4 else 0
    if not 1 <= count <= MAX_COEFFICIENTS:
        raise expected(0, f"a count of 1 to {MAX_COEFFICIENTS}, then that number of polynomial coefficients")
    polynomial = numbers(0, "a count and polynomial coefficients", count + 1)[1:]
    row, column = numbers(-3, "row and column of the centre", 2)
    c, d, e = numbers(-2, "affine c d e", 3)
    height, width = numbers(-1, "height and width of the image", 2)
    require_image_size(f"{name}, line {lines[-1][0]}", width, height)
    with within(f"{name}: "):
        return OcamCamera(polynomial, (row, column), (c, d, e), (int(width), int(height)), view)


def _word_lines(text: str | bytes, name: str) -> list[tuple[int, list[str]]]:
    """Return number and words of each line that has some, without comments (# here, % in MATLAB) and commas."""
    lines = enumerate(decode(text, name).splitlines(), 1)
    found = [(number, re.split(r"[#%]", line, maxsplit=1)[0].replace(",", " ").split()) for number, line in lines]
    return [(number, words) for number, words in found if words]


class TransformTable(Struct, frozen=True):
    """A file with the transform between two cameras."""

    T_lower_upper: Matrix | None = None
    T_upper_lower: Matrix | None = None


def read_transform(path: Path) -> Array:
    """Read T_lower_upper (4, 4): TOML or YAML with that key (or T_upper_lower), or a text of its 16 numbers."""
    data, name = read_bytes(path, MAX_BYTES), str(path)
    with within(f"{name}: "):
        if path.suffix in (".toml", ".yaml", ".yml", ".json"):
            table = table_of(data) if path.suffix == ".toml" else dict(load_mapping(data, name))
            found = _stated(convert(TransformTable, table), "T_lower_upper", name, silent)
            if found is None:
                raise CalibError("expected either T_lower_upper or T_upper_lower")
            return found
        with within("expected 16 numbers, the 4 rows of T_lower_upper: "):
            numbers = np.array([float(word) for _, words in _word_lines(data, name) for word in words])
            rows = numbers.reshape(4, 4).tolist()
        return transform_of(rows, "T_lower_upper")


def straight_up(baseline_m: float) -> Array:
    """Return T_lower_upper of an upper camera straight above the lower one, equally oriented, both looking up.

    A lens that looks up, and a camera that looks up into its mirror, both have their z axis pointing down.
    """
    if not (np.isfinite(baseline_m) and baseline_m >= MIN_BASELINE_M):
        raise CalibError(f"--baseline: expected metres, {MIN_BASELINE_M} or more, found {baseline_m}")
    return se3.transform(np.eye(3), (0.0, 0.0, -baseline_m))


# 4. Stitched images.
def stacked_rig(size: tuple[int, int], baseline_m: float) -> Rig:
    """Return the rig of two cameras of stitched images, the upper one baseline_m straight above, equally oriented."""
    if not (np.isfinite(baseline_m) and MIN_BASELINE_M <= baseline_m <= MAX_BASELINE_M):
        raise CalibError(f"baseline: expected {MIN_BASELINE_M} to {MAX_BASELINE_M} m, found {baseline_m}")
    if size[0] != 2 * size[1] and size != HELVIPAD_SIZE:
        raise CalibError(
            f"equirectangular images: expected twice as many columns as rows, a full turn by half a turn, "
            f"or {HELVIPAD_SIZE[0]}x{HELVIPAD_SIZE[1]} as Helvipad has, found {size[0]}x{size[1]}; rows "
            "that were cut off are told by pv in a rig.toml of the model equirectangular"
        )
    camera = full_turn(size, HELVIPAD_TOP_PX if size == HELVIPAD_SIZE else 0)
    # The camera's z is ahead in the middle of the image: the rig's x; its x is the rig's -y, its y the rig's -z.
    R_rig_cam = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    lower, upper = (
        MountedCamera(camera, se3.inverse(se3.transform(R_rig_cam, np.array([0.0, 0.0, height_m]))))
        for height_m in (0.0, baseline_m)
    )
    return Rig(lower, upper)


def helvipad_rig(values: Mapping[str, Any], name: str) -> Rig:
    """Return the rig of the values of Helvipad's calibration.json."""
    baseline = values.get("stereo_baseline")
    if not isinstance(baseline, int | float) or isinstance(baseline, bool):
        raise CalibError(f"{name}: expected the number 'stereo_baseline' [cm], found {shown(baseline)}")
    return stacked_rig(HELVIPAD_SIZE, 0.01 * float(baseline))
