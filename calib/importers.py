"""Calibrations of other programs as rigs of omnid.

- Chains of cameras: Kalibr's `camchain.yaml` (p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0, t_imu = t_cam +
  timeshift_cam_imu; T_cam_imu is taken for T_cam_rig) and basalt's `calibration.json`.
- Files of one camera each: OCamCalib, ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal (VINS). The transform
  between two is in them (EuRoC's T_BS, the rectification of a stereo camera_info), or it has a file, or it is straight
  up.
- Stitched images of two 360-degree cameras: by their baseline, or of the data set Helvipad (Zayene et al. 2025), whose
  images are the rows 192 to 703 of stitched images of 1920x960, and whose calibration.json has `stereo_baseline` [cm].

Programs write the same thing in several ways. Keys are therefore compared without regard to case; numbers may stand in
a list, in rows, in a text or in a matrix of OpenCV; a table that only wraps one other table is unwrapped.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

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
from calib.typed_toml import shown, table_of
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

Table: TypeAlias = Mapping[str, Any]
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
# Keys of one thing, in files of camera_info, of EuRoC and Kalibr, and in messages.
MATRIX: Final = ("camera_matrix", "k")
TERMS: Final = ("distortion_coefficients", "distortion_coeffs", "d")
RECTIFICATION, PROJECTION = ("rectification_matrix", "r"), ("projection_matrix", "p")
WIDTH, HEIGHT = ("image_width", "width"), ("image_height", "height")
TERM_COUNTS: Final = (0, 4, 5, 8, 12, 14)  # of OpenCV's model
# Size of the images of Helvipad, and their first row in the whole image.
HELVIPAD_SIZE, HELVIPAD_TOP_PX = (1920, 512), 192


# 1. What tables state.
def load_table(data: str | bytes, name: str) -> Table:
    """Parse a file of another program; tables that only wrap one other table are unwrapped."""
    values = load_mapping(data, name)
    while len(values) == 1:
        ((key, inner),) = values.items()
        if not isinstance(inner, Mapping) or re.fullmatch(r"cam\d{1,3}", key):
            break
        values = inner
    return values


def is_one_camera(values: Table) -> bool:
    """True for the values of a file of one camera."""
    known = "model_type" in values or "T_BS" in values
    return known or all(any(_value(values, key) is not None for key in keys) for keys in (MATRIX, TERMS))


def _value(values: Table, *keys: str) -> Any:
    """Return the value of the first of these keys that is present (any case), None if none is."""
    known = {key.lower(): value for key, value in values.items()}
    return next((known[key.lower()] for key in keys if known.get(key.lower()) is not None), None)


def _numbers(values: Table, keys: tuple[str, ...], counts: Sequence[int] = ()) -> Array:
    """Return the finite numbers (N,) under one of several equivalent keys; counts: permitted values of N, (): any."""
    value = _value(values, *keys)
    try:
        found = np.array([] if value is None else value, float).ravel()
    except (TypeError, ValueError, OverflowError):
        found = np.array([np.nan])
    if not np.isfinite(found).all() or (counts and len(found) not in counts):
        expected = f"{' or '.join(map(str, counts))} number{'s' * (counts != (1,))}" if counts else "numbers"
        raise CalibError(f"{keys[0]}: expected {expected}, found {'nothing' if value is None else shown(value)}")
    return found


def _size(values: Table) -> tuple[int, int]:
    """Return width and height of the images."""
    is_list = _value(values, "resolution") is not None
    keys = (("resolution",),) if is_list else (WIDTH, HEIGHT)
    width, height = np.concatenate([_numbers(values, one, (2 if is_list else 1,)) for one in keys]).tolist()
    require_image_size(keys[0][0], width, height)
    return int(width), int(height)


def _transform(values: Table, key: str, place: str = "", warn: Warn = silent) -> Array | None:
    """Return the transform (4, 4) under a key with 12 or 16 numbers, None without it; place: prefix of messages."""
    if _value(values, key) is None:
        return None
    numbers = _numbers(values, (key,), (12, 16))
    return transform_of([*numbers.reshape(-1, 4).tolist(), [0.0, 0.0, 0.0, 1.0]][:4], f"{place}{key}", warn)


def _stated(values: Table, key: str, place: str, warn: Warn) -> Array | None:
    """Return the transform that a key of INVERSES names, from that key or its inverse's; None without both."""
    with within(f"{place}." if place else ""):
        own, other = (
            _transform(values, name, warn=lambda line: warn(f"{place}.{line}")) for name in (key, INVERSES[key])
        )
    if own is not None and other is not None:
        _require_consistency(place, own, se3.inverse(other), (key, INVERSES[key]))
    if own is not None or other is None:
        return own
    warn(f"{place}.{INVERSES[key]} is the inverse of {key}, and is read as that")
    return se3.inverse(other)


def _require_consistency(camera: str, one: Array, other: Array, keys: tuple[str, str]) -> None:
    """Raise CalibError for transforms that differ; the message names the case that one is the inverse of the other."""
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


def _model(values: Table, warn: Warn) -> OmniCamera:
    """Return the camera that a table of any program describes; errors begin with the key that is wrong."""
    # 1. Models whose numbers have names: those of basalt, and of camodocal, as VINS-Mono and VINS-Fusion use it.
    if "camera_type" in values:
        numbers = {key: float(value) for key, value in values["intrinsics"].items()}
        return camera_of_names("camera_type", str(values["camera_type"]), numbers, _size(values), warn)
    if "model_type" in values:
        kind, found = str(values["model_type"]).upper(), dict[str, float]()
        for table in ("mirror_parameters", "distortion_parameters", "projection_parameters"):
            part = values.get(table)
            found |= {str(key): float(value) for key, value in (part if isinstance(part, Mapping) else {}).items()}
        if kind == "SCARAMUZZA":
            raise CalibError("model_type: of SCARAMUZZA, import the calib_results.txt of OCamCalib")
        return camera_of_names("model_type", kind, found, _size(values), warn)
    # 2. The matrix of camera_info, in YAML or as a message, and of OpenCV's calibration sample.
    if _value(values, *MATRIX) is not None:
        K, terms = _numbers(values, MATRIX, (9,)), _numbers(values, TERMS, TERM_COUNTS).tolist()
        model = "fisheye" if values.get("fisheye_model") else str(_value(values, "distortion_model") or "plumb_bob")
        return camera_of_lists(("pinhole", model), [K[0], K[4], K[2], K[5]], terms, _size(values), warn)
    # 3. The lists of Kalibr and EuRoC.
    names = str(_value(values, "camera_model") or ""), str(_value(values, "distortion_model") or "")
    intrinsics, terms = _numbers(values, ("intrinsics",)).tolist(), _numbers(values, TERMS).tolist()
    return camera_of_lists(names, intrinsics, terms, _size(values), warn)


# 2. Chains of cameras.
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
        cameras = _chain_cameras(load_table(text, name))
        return _chain_rig(cameras, (lower, upper), frame, lambda line: warn(f"{name}: {line}"))


def _chain_rig(cameras: Mapping[str, Table], named: tuple[str, str], frame: str, warn: Warn) -> Rig:
    # 1. The poses of the cameras, and which of them is lower.
    poses, has_rig_frame = _chain_poses(cameras, warn)
    topics = {key: _value(camera, "rostopic") or "" for key, camera in cameras.items()}
    for key, topic in topics.items():
        if not isinstance(topic, str):
            raise CalibError(f"{key}.rostopic: expected a string, found {shown(topic)}")
    low, up = _named_cameras(list(cameras), named) or _by_topics(topics)
    if not low:
        low, up = _by_height(cameras, poses, warn, has_rig_frame=has_rig_frame)
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
    if has_rig_frame and frame == "imu":
        mounted = [MountedCamera(model, poses[key]) for model, key in zip(models, (low, up), strict=True)]
        rig = Rig(mounted[0], mounted[1], topics=(topics[low], topics[up]))
        x, y, z = rig.upper.viewpoint - rig.lower.viewpoint
        lean_rad = np.arctan2(np.hypot(x, y), z)
        if lean_rad > MAX_LEAN_RAD:
            warn(
                "expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
                f"{np.rad2deg(lean_rad):.0f} deg off: give --frame cameras, by which the rig frame follows from the "
                "cameras, or add T_base_rig to the rig"
            )
    else:
        rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), (topics[low], topics[up]))
        for note in mounting_notes(rig):
            warn(f"{note} (or T_cn_cnm1 is inverted: write it as T_cnm1_cn)" if is_turned_over(rig) else note)
    # 4. The delay of the upper camera: the difference of both cameras' shifts against the IMU's clock.
    shifts = [_numbers(cameras[key], ("timeshift_cam_imu",), (0, 1)).tolist() for key in (low, up)]
    delay_s = shifts[1][0] - shifts[0][0] if all(shifts) else 0.0
    with within("timeshift_cam_imu: "):
        return replace(rig, times=ShutterTimes(delay_s if abs(delay_s) >= MIN_DELAY_S else 0.0))


def _chain_cameras(values: Table) -> dict[str, Table]:
    """Return the tables of cam0, cam1, ... in ascending order."""
    if "T_imu_cam" in values:
        return _basalt_cameras(values)
    names = [key for key in values if re.fullmatch(r"cam\d{1,3}", key)]
    if len(names) < 2:
        others = shown(sorted(values)) if values else "none"
        raise CalibError(
            f"expected two cameras (cam0, cam1), found {', '.join(names) or others}; files of one camera each are "
            "given as --lower and --upper"
        )
    for key in names:
        if not isinstance(values[key], Mapping):
            raise CalibError(f"{key}: expected a table, found {shown(values[key])}")
    return {key: values[key] for key in sorted(names, key=lambda key: int(key[3:]))}


def _basalt_cameras(values: Table) -> dict[str, Table]:
    """Return the cameras of basalt's calibration: p_imu = T_imu_cam p_cam, as a position and a quaternion."""
    try:
        found = dict[str, Table]()
        parts = zip(values["T_imu_cam"], values["intrinsics"], values["resolution"], strict=True)
        for number, (pose, lens, size) in enumerate(parts):
            R = se3.rotation([pose[key] for key in ("qx", "qy", "qz", "qw")])
            T_cam_imu = se3.inverse(se3.transform(R, [pose[key] for key in ("px", "py", "pz")]))
            found[f"cam{number}"] = {**lens, "resolution": size, "T_cam_imu": T_cam_imu.tolist()}
        if not all(isinstance(camera["intrinsics"], Mapping) and "camera_type" in camera for camera in found.values()):
            raise ValueError("no camera_type or intrinsics")
    except (KeyError, TypeError, ValueError) as error:
        raise CalibError(
            f"expected basalt's calibration with T_imu_cam, intrinsics and resolution of each camera: {error!r}"
        ) from error
    if not found:
        raise CalibError("expected basalt's calibration with T_imu_cam, intrinsics and resolution, found no camera")
    return found


def _chain_model(key: str, camera: Table, warn: Warn) -> OmniCamera:
    """Return one camera of a chain; errors begin with the name of that camera."""
    try:
        return _model(camera, lambda line: warn(f"{key}: {line}"))
    except (CalibError, ValueError, TypeError) as error:
        dot = "." if re.match(r"[a-z_]+: ", str(error)) else ": "
        raise CalibError(f"{key}{dot}{error}") from error


def _chain_poses(cameras: Mapping[str, Table], warn: Warn) -> tuple[dict[str, Array], bool]:
    """Return T_cam_common of each camera; True if the common frame is the rig's, False if it is cam0's."""
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


def _named_cameras(names: Sequence[str], named: tuple[str, str]) -> tuple[str, str] | None:
    """Return the names of the lower and the upper camera that the user gave, None if none was given."""
    for name in filter(None, named):
        if name not in names:
            raise CalibError(f"there is no camera {name}, found {', '.join(names)}")
    if len(names) > 2 and not all(named):
        raise CalibError(f"expected two cameras, found {', '.join(names)}; give --lower and --upper")
    if not any(named):
        return None
    other = [name for name in names if name not in named]
    low, up = named[0] or other[0], named[1] or other[0]
    if low == up:
        raise CalibError(f"lower and upper must be two cameras, found {low} for both")
    return low, up


def _by_topics(topics: Mapping[str, str]) -> tuple[str, str]:
    """Return the names of the lower and the upper camera by words in their topics; two empty names: undecided."""
    words = [set(re.split(r"[^a-z]+", topic.lower())) for topic in topics.values()]
    first, second = (bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words)
    one, other = topics
    return ("", "") if first == second else (one, other) if first > second else (other, one)


def _by_height(
    cameras: Mapping[str, Table], poses: Mapping[str, Array], warn: Warn, *, has_rig_frame: bool
) -> tuple[str, str]:
    """Return the names of the lower and the upper camera by their heights in the rig frame.

    Without a rig frame the order counts in which the lower part of their images lies below.
    """
    one, other = cameras
    orders = [(one, other), (other, one)] if len(poses) == 2 else []
    if has_rig_frame:
        heights = {name: float(se3.inverse(T)[2, 3]) for name, T in poses.items()}
        orders = [(low, up) for low, up in orders if heights[up] - heights[low] >= MAX_DISAGREEMENT_M]
    else:
        models = {name: _chain_model(name, cameras[name], silent) for name in cameras}
        rigs = {(a, b): rig_between(models[a], models[b], poses[a] @ se3.inverse(poses[b])) for a, b in orders}
        orders = [order for order, rig in rigs.items() if not is_turned_over(rig)]
    if len(orders) != 1:
        raise CalibError(
            f"neither topics nor heights identify the lower camera; name it, --lower {one} or --lower {other}"
        )
    ((low, up),) = orders
    if has_rig_frame:
        warn(f"lower is {low} by z of the IMU, which must point up; if it does not, give --lower {up}")
    else:
        warn(f"lower is {low} by what is below in the images; if the cameras stand upside down, give --lower {up}")
    return low, up


# 3. Files of one camera each.
def import_pair(
    lower_path: Path, upper_path: Path, T_lower_upper: Array | None, view: View = "mirror", warn: Warn = silent
) -> Rig:
    """Read the rig of two files of one camera each; its frame is the lower viewpoint's, see rig_between.

    T_lower_upper: None if the files state the transform.
    """
    (lower, T_body_lower), (upper, T_body_upper) = (read_camera(path, view, warn) for path in (lower_path, upper_path))
    if T_lower_upper is None and T_body_lower is not None and T_body_upper is not None:
        T_lower_upper = se3.inverse(T_body_lower) @ T_body_upper
    if T_lower_upper is None or not se3.t_of(T_lower_upper).any():
        raise CalibError(
            f"{lower_path} and {upper_path} do not contain the transform between the cameras: give --transform FILE or "
            "--baseline METRES"
        )
    rig = rig_between(lower, upper, T_lower_upper)
    for note in mounting_notes(rig):
        warn(note)
    return rig


def read_camera(path: Path, view: View = "mirror", warn: Warn = silent) -> tuple[OmniCamera, Array | None]:
    """Read a file of one camera; its content shows which program wrote it. Return the camera and its pose.

    view: for files of OCamCalib. The pose is T_body_cam, or T_stereo_cam of a rectified pair; None if it is not stated.
    """
    data, name = read_bytes(path, MAX_JSON_BYTES), str(path)
    is_named = path.suffix.lower() in (".yaml", ".yml", ".json", ".xml")
    first = next((words for _, words in _word_lines(data, name)), ["", ""])
    if not is_named or (first[0].isdigit() and len(first) > 1):
        return parse_ocam(data, view, name), None
    values = load_table(data, name)
    if not is_one_camera(values):
        raise CalibError(
            f"{name}: expected one camera as ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal or OCamCalib "
            f"write it, found the keys {shown(sorted(values))}"
        )

    def told(line: str) -> None:
        warn(f"{name}: {line}")

    with within(f"{name}: "):
        camera, T = _model(values, told), _transform(values, "T_BS", warn=told)
        if T is None and _value(values, *PROJECTION) is not None:
            R = _numbers(values, RECTIFICATION, (9,)).reshape(3, 3)
            P = _numbers(values, PROJECTION, (12,)).reshape(3, 4)
            if P[0, 0] and P[1, 1] and R.any():  # else it is not calibrated as one of two
                # A point R p_cam of the rectified pair is seen at P = K' [I | t].
                t = np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0])
                T = transform_of(se3.transform(R, -t).tolist(), "R", told)
        return camera, T


# 4. OCamCalib's `calib_results.txt`, and the transform between two cameras.
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
            values = tuple(map(_number, lines[at][1]))
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            raise expected(at, f"{count} finite numbers ({what})")
        return values

    lead = re.fullmatch(r"(\d{1,3})(\.0*)?", lines[0][1][0], re.ASCII)
    count = int(lead[1]) if lead else 0
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
    """Return number and words of each line with words; commas and comments (#, MATLAB's %, C's //) are removed."""
    lines = enumerate(decode(text, name).splitlines(), 1)
    found = [(number, re.split(r"[#%]|//", line, maxsplit=1)[0].replace(",", " ").split()) for number, line in lines]
    return [(number, words) for number, words in found if words]


def _number(word: str) -> float:
    """Return the number of a word; its exponent may be written with Fortran's d. ValueError for other words."""
    return float(re.sub(r"(?<=[\d.])[dD](?=[-+\d])", "e", word))


def read_transform(path: Path) -> Array:
    """Read T_lower_upper (4, 4): TOML or YAML with that key (or T_upper_lower), or a text of its 16 numbers."""
    data, name = read_bytes(path, MAX_BYTES), str(path)
    with within(f"{name}: "):
        if path.suffix in (".toml", ".yaml", ".yml", ".json"):
            table = table_of(data) if path.suffix == ".toml" else load_table(data, name)
            found = _stated(table, "T_lower_upper", "", silent)
            if found is None:
                raise CalibError(
                    f"expected either T_lower_upper or T_upper_lower, found the keys {shown(sorted(table))}"
                )
            return found
        with within("expected 16 numbers, the 4 rows of T_lower_upper: "):
            numbers = np.array([_number(word) for _, words in _word_lines(data, name) for word in words])
            rows = numbers.reshape(4, 4).tolist()
        return transform_of(rows, "T_lower_upper")


def straight_up(baseline_m: float) -> Array:
    """Return T_lower_upper of an upper camera straight above the lower one, equally oriented, both looking up.

    A lens that looks up, and a camera that looks up into its mirror, both have their z axis pointing down.
    """
    if not (np.isfinite(baseline_m) and baseline_m >= MIN_BASELINE_M):
        raise CalibError(f"--baseline: expected metres, {MIN_BASELINE_M} or more, found {baseline_m}")
    return se3.transform(np.eye(3), (0.0, 0.0, -baseline_m))


# 5. Stitched images.
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


def helvipad_rig(values: Table, name: str) -> Rig:
    """Return the rig of the values of Helvipad's calibration.json."""
    baseline = values.get("stereo_baseline")
    if not isinstance(baseline, int | float) or isinstance(baseline, bool):
        raise CalibError(f"{name}: expected the number 'stereo_baseline' [cm], found {shown(baseline)}")
    return stacked_rig(HELVIPAD_SIZE, 0.01 * float(baseline))
