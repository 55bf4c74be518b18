"""Kalibr's `camchain.yaml`, read and written: T_cam_imu is taken for T_cam_rig. The model omni is written.

Kalibr: p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0 and t_imu = t_cam + timeshift_cam_imu; omni intrinsics
are [xi, fu, fv, pu, pv].
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from ruamel.yaml.error import YAMLError

from calib import se3
from calib.bounded_yaml import MAX_BYTES, parse_yaml
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.lens import lens_camera
from calib.models.names import sees_directly
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig, ShutterTimes
from calib.rig_frame import rig_between
from calib.validation import ValidatedTable, decode, read_bytes

# Tolerance between T_cam_imu and T_cn_cnm1: more than rounding, less than any real difference of two rigs.
MAX_DISAGREEMENT_M = 1e-3
MAX_DISAGREEMENT_RAD = np.deg2rad(0.1)
# Least difference in height by which the lower camera is identified: less may be rounding, as above.
MIN_HEIGHT_M = 1e-3
# Largest angle of the baseline from z of the rig, because no rig leans so far, but the axes of an IMU may be others.
MAX_LEAN_RAD = np.deg2rad(30)
MIN_DELAY_S = 0.5e-3  # between two cameras: less is no different from none, as for `omnid calibrate drive`
LOWER_WORDS, UPPER_WORDS = {"lower", "bottom"}, {"upper", "top"}


def _silent(line: str) -> None:
    """Report nothing."""


def import_kalibr(path: Path, lower: str = "", upper: str = "", warn: Callable[[str], None] = _silent) -> Rig:
    """Read the rig of a Kalibr file; lower and upper: names of cameras (cam0), instead of topic or height."""
    return parse_kalibr(read_bytes(path, MAX_BYTES), str(path), lower, upper, warn)


def parse_kalibr(
    text: str | bytes,
    name: str = "camchain.yaml",
    lower: str = "",
    upper: str = "",
    warn: Callable[[str], None] = _silent,
) -> Rig:
    """Parse the rig of a Kalibr file's text; warn: takes lines about axes of the IMU that may not be a rig's."""
    file = ValidatedTable(load_yaml(text, name), name)
    cameras = {key: file.table(key) for key in _camera_names(file)}
    poses, has_rig_frame = _chain(cameras)
    low, up = _lower_and_upper(file, (lower, upper), poses if has_rig_frame else {}, warn)
    models = [_camera(cameras[key]) for key in (low, up)]
    _warn_of_lens(models, name, warn)
    topics = (_topic(cameras[low]), _topic(cameras[up]))
    if not {low, up} <= poses.keys():
        raise CalibError(f"{name}: no transform between {low} and {up}; expected T_cam_imu of both, or T_cn_cnm1")
    if has_rig_frame:
        rig = Rig(MountedCamera(models[0], poses[low]), MountedCamera(models[1], poses[up]), topics=topics)
        _warn_of_lean(rig, name, warn)
    else:
        rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), topics)
    return replace(rig, times=_times(cameras[low], cameras[up]))


def _warn_of_lens(models: list[OmniCamera], name: str, warn: Callable[[str], None]) -> None:
    """Warn of cameras that may be mirrors whose images were flipped: nothing in the file tells them from lenses."""
    if any(isinstance(camera, UnifiedCamera) and camera.xi > 0 and sees_directly(camera) for camera in models):
        warn(
            f"{name}: its omni cameras count as lenses, by their focal lengths; if these are mirrors whose images were "
            "flipped, give them masks in the rig.toml"
        )


def _warn_of_lean(rig: Rig, name: str, warn: Callable[[str], None]) -> None:
    """Warn of a baseline that does not point up in the axes of the IMU."""
    x, y, z = rig.upper.viewpoint - rig.lower.viewpoint
    lean_rad = np.arctan2(np.hypot(x, y), z)
    if lean_rad > MAX_LEAN_RAD:
        warn(
            f"{name}: expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
            f"{np.rad2deg(lean_rad):.0f} deg off: remove T_cam_imu, so that T_cn_cnm1 counts, or add T_base_rig to "
            "the rig"
        )


def _times(lower: ValidatedTable, upper: ValidatedTable) -> ShutterTimes:
    """Return the delay of the upper camera: the difference of both cameras' shifts against the IMU's clock."""
    if not (lower.has("timeshift_cam_imu") and upper.has("timeshift_cam_imu")):
        return ShutterTimes()
    delay_s = upper.number("timeshift_cam_imu") - lower.number("timeshift_cam_imu")
    try:
        return ShutterTimes(delay_s) if abs(delay_s) >= MIN_DELAY_S else ShutterTimes()
    except CalibError as error:
        raise CalibError(f"{upper.file}: timeshift_cam_imu: {error}") from error


def load_yaml(text: str | bytes, name: str) -> Mapping[object, object]:
    """Parse a YAML text (plain data only) and return its mapping."""
    try:
        values = parse_yaml(decode(text, name))
    except (YAMLError, ValueError, RecursionError, TypeError, LookupError, AttributeError) as error:
        raise CalibError(f"{name}: not a YAML file: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(values, Mapping):
        raise CalibError(f"{name}: expected a YAML mapping, found {type(values).__name__}")
    return values


def _camera_names(file: ValidatedTable) -> list[str]:
    """Return cam0, cam1, ... in ascending order."""
    names = [key for key in file.values if isinstance(key, str) and re.fullmatch(r"cam\d{1,3}", key)]
    if len(names) < 2:
        raise CalibError(f"{file.file}: expected two cameras (cam0, cam1), found {', '.join(names) or 'none'}")
    return sorted(names, key=lambda key: int(key[3:]))


def _chain(cameras: dict[str, ValidatedTable]) -> tuple[dict[str, Array], bool]:
    """Return transforms from one common frame into each camera; True if that frame is the rig's, False if cam0's."""
    poses = {key: table.transform("T_cam_imu") for key, table in cameras.items() if table.has("T_cam_imu")}
    has_rig_frame = bool(poses)
    links = [
        (before, key, cameras[key].transform("T_cn_cnm1"))
        for before, key in pairwise(cameras)
        if int(key[3:]) == int(before[3:]) + 1 and cameras[key].has("T_cn_cnm1")
    ]
    if not has_rig_frame:
        poses[next(iter(cameras))] = np.eye(4)
    for before, key, T_key_before in links:
        if before in poses and key in poses:
            _require_consistency(cameras[key], poses[key] @ se3.inverse(poses[before]), T_key_before)
        elif before in poses:
            poses[key] = T_key_before @ poses[before]
    for before, key, T_key_before in reversed(links):
        if key in poses and before not in poses:
            poses[before] = se3.inverse(T_key_before) @ poses[key]
    return poses, has_rig_frame


def _require_consistency(table: ValidatedTable, by_imu: Array, by_chain: Array) -> None:
    gap = se3.inverse(by_imu) @ by_chain
    distance, angle = np.linalg.norm(by_imu[:3, 3] - by_chain[:3, 3]), np.linalg.norm(se3.rotation_log(gap[:3, :3]))
    if distance > MAX_DISAGREEMENT_M or angle > MAX_DISAGREEMENT_RAD:
        raise CalibError(
            f"{table.file}: {table.path}: T_cam_imu and T_cn_cnm1 contradict each other by "
            f"{distance * 1e3:.1f} mm and {np.rad2deg(angle):.2f} deg; remove the one that is wrong"
        )


def _lower_and_upper(
    file: ValidatedTable, named: tuple[str, str], poses: dict[str, Array], warn: Callable[[str], None]
) -> tuple[str, str]:
    """Return the names of the lower and the upper camera: as named, else by topic, else by height in the rig frame."""
    names = _camera_names(file)
    for name in filter(None, named):
        if name not in names:
            raise CalibError(f"{file.file}: there is no camera {name}, found {', '.join(names)}")
    if len(names) > 2 and not all(named):
        raise CalibError(f"{file.file}: expected two cameras, found {', '.join(names)}; give --lower and --upper")
    if any(named):
        other = [name for name in names if name not in named]
        pair = named[0] or other[0], named[1] or other[0]
    else:
        pair = _by_topic(file, names) or _by_height(file, names, poses, warn)
    if pair[0] == pair[1]:
        raise CalibError(f"{file.file}: lower and upper must be two cameras, found {pair[0]} for both")
    return pair


def _by_topic(file: ValidatedTable, names: list[str]) -> tuple[str, str] | None:
    words = [set(re.split(r"[^a-z]+", _topic(file.table(name)).lower())) for name in names]
    low = [bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words]
    if low[0] == low[1]:
        return None
    return (names[0], names[1]) if low[0] > low[1] else (names[1], names[0])


def _by_height(
    file: ValidatedTable, names: list[str], poses: dict[str, Array], warn: Callable[[str], None]
) -> tuple[str, str]:
    heights = [float(se3.inverse(poses[name])[2, 3]) for name in names if name in poses]
    if len(heights) < 2 or abs(heights[0] - heights[1]) < MIN_HEIGHT_M:
        raise CalibError(
            f"{file.file}: neither topics nor heights identify the lower camera; name it, "
            f"--lower {names[0]} or --lower {names[1]}"
        )
    low, up = (names[0], names[1]) if heights[0] < heights[1] else (names[1], names[0])
    warn(f"{file.file}: lower is {low} by z of the IMU, which must point up; if it does not, give --lower {up}")
    return low, up


def _topic(table: ValidatedTable) -> str:
    return table.text("rostopic") if table.has("rostopic") else ""


def _camera(table: ValidatedTable) -> OmniCamera:
    """Return a camera of Kalibr's models omni, ds and eucm, and pinhole with radtan or equidistant distortion."""
    model = table.choice("camera_model", ("omni", "ds", "eucm", "pinhole"))
    size = table.size("resolution")
    try:
        if model in ("ds", "eucm"):
            table.choice("distortion_model", ("none",))
            first, second, fu, fv, pu, pv = table.numbers("intrinsics", 6)
            return lens_camera(model, (first, second), (fu, fv), (pu, pv), size)
        numbers = table.numbers("intrinsics", 5 if model == "omni" else 4)
        xi, fu, fv, pu, pv = numbers if model == "omni" else (0.0, *numbers)
        names = ("radtan", "none") if model == "omni" else ("radtan", "none", "equidistant")
        distortion = table.choice("distortion_model", names)
        terms = table.numbers("distortion_coeffs", 4) if distortion != "none" else (0.0, 0.0, 0.0, 0.0)
        if distortion == "equidistant":
            return lens_camera("equidistant", terms, (fu, fv), (pu, pv), size)
        k1, k2, p1, p2 = terms
        return UnifiedCamera(xi, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))
    except CalibError as error:
        if str(error).startswith(table.file):
            raise
        raise CalibError(f"{table.file}: {table.path}: {error}") from error
