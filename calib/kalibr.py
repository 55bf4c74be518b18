"""Chains of cameras: Kalibr's `camchain.yaml` and basalt's `calibration.json`. T_cam_imu is taken for T_cam_rig.

Kalibr: p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0 and t_imu = t_cam + timeshift_cam_imu; omni intrinsics
are [xi, fu, fv, pu, pv].
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from msgspec import Struct

from calib import se3
from calib.errors import CalibError
from calib.foreign_models import camera_of, camera_of_lists
from calib.models.camera import Array, OmniCamera
from calib.models.names import sees_directly
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig, ShutterTimes
from calib.rig_frame import is_turned_over, mounting_notes, rig_between
from calib.text_files import MAX_JSON_BYTES, load_mapping
from calib.typed_toml import convert, shown
from calib.validation import Warn, read_bytes, silent, transform_of

# Tolerance between T_cam_imu and T_cn_cnm1: more than rounding, less than any real difference of two rigs.
MAX_DISAGREEMENT_M = 1e-3
MAX_DISAGREEMENT_RAD = np.deg2rad(0.1)
# Least difference in height by which the lower camera is identified: less may be rounding, as above.
MIN_HEIGHT_M = 1e-3
# Largest angle of the baseline from z of the rig, because no rig leans so far, but the axes of an IMU may be others.
MAX_LEAN_RAD = np.deg2rad(30)
MIN_DELAY_S = 0.5e-3  # between two cameras: less is no different from none, as for `omnid calibrate drive`
LOWER_WORDS, UPPER_WORDS = {"lower", "bottom"}, {"upper", "top"}
Matrix: TypeAlias = tuple[tuple[float, ...], ...]
# Models of basalt, and those of foreign_models.py.
BASALT: Final = {
    "ds": "ds",
    "kb4": "equidistant",
    "eucm": "eucm",
    "ucm": "ucm",
    "pinhole": "pinhole",
    "pinhole-radtan8": "pinhole",
    "fov": "fov",
}
# Keys of the inverse of a transform, which neighbours write instead: OpenVINS, VINS.
INVERSES: Final = {"T_cam_imu": "T_imu_cam", "T_cn_cnm1": "T_cnm1_cn"}


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

    def transform(self, key: str, camera: str, warn: Warn) -> Array | None:
        """Return the transform of a key of INVERSES, from its own key or that of its inverse; None without both."""
        own, other = (getattr(self, name) for name in (key, INVERSES[key]))
        found = None if own is None else transform_of(own, f"{camera}.{key}", warn)
        if other is None:
            return found
        inverse = se3.inverse(transform_of(other, f"{camera}.{INVERSES[key]}", warn))
        if found is not None:
            _require_consistency(camera, found, inverse, (key, INVERSES[key]))
            return found
        warn(f"{camera}.{INVERSES[key]} is the inverse of {key}, and is read as that")
        return inverse


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
    try:
        return _rig(_cameras(load_mapping(text, name)), (lower, upper), frame, lambda line: warn(f"{name}: {line}"))
    except (CalibError, ValueError) as error:
        raise error if str(error).startswith(f"{name}: ") else CalibError(f"{name}: {error}") from error


def _rig(cameras: Mapping[str, ChainCamera], named: tuple[str, str], frame: str, warn: Warn) -> Rig:
    poses, has_rig_frame = _chain(cameras, warn)
    low, up = _lower_and_upper(cameras, named, poses, warn, has_rig_frame=has_rig_frame)
    models = [_camera(key, cameras[key], warn) for key in (low, up)]
    _warn_of_lens(models, warn)
    topics = (cameras[low].rostopic, cameras[up].rostopic)
    if not {low, up} <= poses.keys():
        raise CalibError(f"no transform between {low} and {up}; expected T_cam_imu of both, or T_cn_cnm1")
    if has_rig_frame and frame == "imu":
        rig = Rig(MountedCamera(models[0], poses[low]), MountedCamera(models[1], poses[up]), topics=topics)
        _warn_of_lean(rig, warn)
    else:
        rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), topics)
        for note in mounting_notes(rig):
            warn(f"{note} (or T_cn_cnm1 is inverted: write it as T_cnm1_cn)" if is_turned_over(rig) else note)
    return replace(rig, times=_times(cameras[low], cameras[up]))


def _warn_of_lens(models: list[OmniCamera], warn: Warn) -> None:
    """Warn of cameras that may be mirrors whose images were flipped: nothing in the file tells them from lenses."""
    if any(isinstance(camera, UnifiedCamera) and camera.xi > 0 and sees_directly(camera) for camera in models):
        warn(
            "its omni cameras count as lenses, by their focal lengths; if these are mirrors whose images were "
            "flipped, give them masks in the rig.toml"
        )


def _warn_of_lean(rig: Rig, warn: Warn) -> None:
    """Warn of a baseline that does not point up in the axes of the IMU."""
    x, y, z = rig.upper.viewpoint - rig.lower.viewpoint
    lean_rad = np.arctan2(np.hypot(x, y), z)
    if lean_rad > MAX_LEAN_RAD:
        warn(
            "expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
            f"{np.rad2deg(lean_rad):.0f} deg off: give --frame cameras, by which the rig frame follows from the "
            "cameras, or add T_base_rig to the rig"
        )


def _times(lower: ChainCamera, upper: ChainCamera) -> ShutterTimes:
    """Return the delay of the upper camera: the difference of both cameras' shifts against the IMU's clock."""
    if lower.timeshift_cam_imu is None or upper.timeshift_cam_imu is None:
        return ShutterTimes()
    delay_s = upper.timeshift_cam_imu - lower.timeshift_cam_imu
    try:
        return ShutterTimes(delay_s) if abs(delay_s) >= MIN_DELAY_S else ShutterTimes()
    except CalibError as error:
        raise CalibError(f"timeshift_cam_imu: {error}") from error


def _cameras(values: Mapping[str, Any]) -> dict[str, ChainCamera]:
    """Return cam0, cam1, ... in ascending order."""
    values = values.get("value0", values)
    if not isinstance(values, Mapping) or "T_imu_cam" in values:
        return _basalt(values)
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


def _basalt(value: Any) -> dict[str, ChainCamera]:
    """Return the cameras of basalt's calibration: p_imu = T_imu_cam p_cam, as a position and a quaternion."""
    try:
        parts = zip(value["T_imu_cam"], value["intrinsics"], value["resolution"], strict=True)
        return {
            f"cam{number}": ChainCamera(
                resolution=(int(width), int(height)),
                T_cam_imu=_rows(
                    se3.inverse(
                        se3.transform(
                            se3.rotation([pose[key] for key in ("qx", "qy", "qz", "qw")]),
                            [pose[key] for key in ("px", "py", "pz")],
                        )
                    )
                ),
                basalt=(str(lens["camera_type"]), {key: float(v) for key, v in lens["intrinsics"].items()}),
            )
            for number, (pose, lens, (width, height)) in enumerate(parts)
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibError(
            f"expected basalt's calibration with T_imu_cam, intrinsics and resolution of each camera: {error!r}"
        ) from error


def _rows(T: Array) -> Matrix:
    return tuple(tuple(row) for row in T.tolist())


def _chain(cameras: Mapping[str, ChainCamera], warn: Warn) -> tuple[dict[str, Array], bool]:
    """Return transforms from one common frame into each camera; True if that frame is the rig's, False if cam0's."""
    own = {key: camera.transform("T_cam_imu", key, warn) for key, camera in cameras.items()}
    poses = {key: T for key, T in own.items() if T is not None}
    has_rig_frame = bool(poses)
    links = [
        (before, key, T)
        for before, key in pairwise(cameras)
        if int(key[3:]) == int(before[3:]) + 1 and (T := cameras[key].transform("T_cn_cnm1", key, warn)) is not None
    ]
    if not has_rig_frame:
        poses[next(iter(cameras))] = np.eye(4)
    for before, key, T_key_before in links:
        if before in poses and key in poses:
            T_by_imu = poses[key] @ se3.inverse(poses[before])
            _require_consistency(key, T_by_imu, T_key_before, ("T_cam_imu", "T_cn_cnm1"))
        elif before in poses:
            poses[key] = T_key_before @ poses[before]
    for before, key, T_key_before in reversed(links):
        if key in poses and before not in poses:
            poses[before] = se3.inverse(T_key_before) @ poses[key]
    return poses, has_rig_frame


def _require_consistency(camera: str, one: Array, other: Array, keys: tuple[str, str]) -> None:
    """Raise CalibError for transforms that differ, and say so where one is the inverse of the other."""
    distance_m, angle_rad = _apart(one, other)
    if distance_m <= MAX_DISAGREEMENT_M and angle_rad <= MAX_DISAGREEMENT_RAD:
        return
    inverse_m, inverse_rad = _apart(one, se3.inverse(other))
    if inverse_m <= MAX_DISAGREEMENT_M and inverse_rad <= MAX_DISAGREEMENT_RAD:
        raise CalibError(f"{camera}: {keys[1]} is the inverse of what {keys[0]} says: invert it, or name it T_cnm1_cn")
    raise CalibError(
        f"{camera}: {keys[0]} and {keys[1]} contradict each other by {distance_m * 1e3:.1f} mm and "
        f"{np.rad2deg(angle_rad):.2f} deg; remove the one that is wrong"
    )


def _apart(one: Array, other: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two transforms."""
    gap = se3.rotation_log((se3.inverse(one) @ other)[:3, :3])
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(np.linalg.norm(gap))


def _lower_and_upper(
    cameras: Mapping[str, ChainCamera],
    named: tuple[str, str],
    poses: dict[str, Array],
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
        pair = named[0] or other[0], named[1] or other[0]
    else:
        pair = _by_topic(cameras) or (
            _by_height(names, poses, warn) if has_rig_frame else _by_images(cameras, poses, warn)
        )
    if pair[0] == pair[1]:
        raise CalibError(f"lower and upper must be two cameras, found {pair[0]} for both")
    return pair


def _by_images(cameras: Mapping[str, ChainCamera], poses: Mapping[str, Array], warn: Warn) -> tuple[str, str]:
    """Return the order in which the upper camera is not below the lower one, by their images."""
    first, second = cameras
    if len(poses) == 2:
        T_first_second = poses[first] @ se3.inverse(poses[second])
        models = {key: _camera(key, cameras[key], silent) for key in (first, second)}
        orders = [(first, second, T_first_second), (second, first, se3.inverse(T_first_second))]
        upright = [(low, up) for low, up, T in orders if not is_turned_over(rig_between(models[low], models[up], T))]
        if len(upright) == 1:
            ((low, up),) = upright
            warn(f"lower is {low} by what is below in the images; if the cameras stand upside down, give --lower {up}")
            return low, up
    raise _unknown_order(first, second)


def _unknown_order(first: str, second: str) -> CalibError:
    return CalibError(
        f"neither topics nor heights identify the lower camera; name it, --lower {first} or --lower {second}"
    )


def _by_topic(cameras: Mapping[str, ChainCamera]) -> tuple[str, str] | None:
    names = list(cameras)
    words = [set(re.split(r"[^a-z]+", camera.rostopic.lower())) for camera in cameras.values()]
    low = [bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words]
    if low[0] == low[1]:
        return None
    return (names[0], names[1]) if low[0] > low[1] else (names[1], names[0])


def _by_height(names: list[str], poses: dict[str, Array], warn: Warn) -> tuple[str, str]:
    heights = [float(se3.inverse(poses[name])[2, 3]) for name in names if name in poses]
    if len(heights) < 2 or abs(heights[0] - heights[1]) < MIN_HEIGHT_M:
        raise _unknown_order(names[0], names[1])
    low, up = (names[0], names[1]) if heights[0] < heights[1] else (names[1], names[0])
    warn(f"lower is {low} by z of the IMU, which must point up; if it does not, give --lower {up}")
    return low, up


def _camera(key: str, camera: ChainCamera, warn: Warn) -> OmniCamera:
    """Return a camera of any model that MODELS of foreign_models.py names."""
    try:
        if camera.basalt is not None:
            kind, numbers = camera.basalt
            if kind not in BASALT:
                raise CalibError(f"camera_type: expected {', '.join(BASALT)}, found {kind!r}")
            renamed = {
                {"fx": "fu", "fy": "fv", "cx": "pu", "cy": "pv"}.get(name, name): v for name, v in numbers.items()
            }
            return camera_of(BASALT[kind], renamed, camera.resolution, lambda line: warn(f"{key}: {line}"))
        names = (camera.camera_model, camera.distortion_model)
        return camera_of_lists(
            names, camera.intrinsics, camera.distortion_coeffs, camera.resolution, lambda line: warn(f"{key}: {line}")
        )
    except KeyError as error:
        raise CalibError(f"{key}: expected the number {error} of its model") from error
    except CalibError as error:
        dot = "." if re.match(r"[a-z_]+: ", str(error)) else ": "
        raise CalibError(f"{key}{dot}{error}") from error
