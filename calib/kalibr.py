"""Kalibr's `camchain.yaml`: T_cam_imu is taken for T_cam_rig.

Kalibr: p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0 and t_imu = t_cam + timeshift_cam_imu; omni intrinsics
are [xi, fu, fv, pu, pv].
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from msgspec import Struct
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, NodeEvent, ScalarEvent

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.lens import lens_camera
from calib.models.names import sees_directly
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig, ShutterTimes
from calib.rig_frame import rig_between
from calib.typed_toml import convert, shown
from calib.validation import MAX_PIXELS, MAX_SIDE_PX, decode, is_image_size, read_bytes, transform_of

# Tolerance between T_cam_imu and T_cn_cnm1: more than rounding, less than any real difference of two rigs.
MAX_DISAGREEMENT_M = 1e-3
MAX_DISAGREEMENT_RAD = np.deg2rad(0.1)
# Least difference in height by which the lower camera is identified: less may be rounding, as above.
MIN_HEIGHT_M = 1e-3
# Largest angle of the baseline from z of the rig, because no rig leans so far, but the axes of an IMU may be others.
MAX_LEAN_RAD = np.deg2rad(30)
MIN_DELAY_S = 0.5e-3  # between two cameras: less is no different from none, as for `omnid calibrate drive`
LOWER_WORDS, UPPER_WORDS = {"lower", "bottom"}, {"upper", "top"}
# Limits of YAML of unknown origin.
MAX_BYTES: Final = 1 << 15  # enough for MAX_NODES of 16 characters
# Values and lists, because a camera has about 60.
MAX_NODES: Final = 2000
MAX_DEPTH: Final = 16  # Lists and mappings within each other: enough, as those of a camera are four deep.
MAX_SCALAR: Final = 1000  # Characters of a value: enough for names of topics and paths.

Matrix: TypeAlias = tuple[tuple[float, ...], ...]


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
    try:
        return _rig(_cameras(load_yaml(text, name)), (lower, upper), lambda line: warn(f"{name}: {line}"))
    except (CalibError, ValueError) as error:
        raise error if str(error).startswith(f"{name}: ") else CalibError(f"{name}: {error}") from error


def _rig(cameras: Mapping[str, ChainCamera], named: tuple[str, str], warn: Callable[[str], None]) -> Rig:
    poses, has_rig_frame = _chain(cameras)
    low, up = _lower_and_upper(cameras, named, poses if has_rig_frame else {}, warn)
    models = [_camera(key, cameras[key]) for key in (low, up)]
    _warn_of_lens(models, warn)
    topics = (cameras[low].rostopic, cameras[up].rostopic)
    if not {low, up} <= poses.keys():
        raise CalibError(f"no transform between {low} and {up}; expected T_cam_imu of both, or T_cn_cnm1")
    if has_rig_frame:
        rig = Rig(MountedCamera(models[0], poses[low]), MountedCamera(models[1], poses[up]), topics=topics)
        _warn_of_lean(rig, warn)
    else:
        rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), topics)
    return replace(rig, times=_times(cameras[low], cameras[up]))


def _warn_of_lens(models: list[OmniCamera], warn: Callable[[str], None]) -> None:
    """Warn of cameras that may be mirrors whose images were flipped: nothing in the file tells them from lenses."""
    if any(isinstance(camera, UnifiedCamera) and camera.xi > 0 and sees_directly(camera) for camera in models):
        warn(
            "its omni cameras count as lenses, by their focal lengths; if these are mirrors whose images were "
            "flipped, give them masks in the rig.toml"
        )


def _warn_of_lean(rig: Rig, warn: Callable[[str], None]) -> None:
    """Warn of a baseline that does not point up in the axes of the IMU."""
    x, y, z = rig.upper.viewpoint - rig.lower.viewpoint
    lean_rad = np.arctan2(np.hypot(x, y), z)
    if lean_rad > MAX_LEAN_RAD:
        warn(
            "expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
            f"{np.rad2deg(lean_rad):.0f} deg off: remove T_cam_imu, so that T_cn_cnm1 counts, or add T_base_rig to "
            "the rig"
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


def load_yaml(text: str | bytes, name: str) -> Mapping[object, object]:
    """Parse a YAML text (plain data only) and return its mapping."""
    try:
        values = parse_yaml(decode(text, name))
    except (YAMLError, ValueError, RecursionError, TypeError, LookupError, AttributeError) as error:
        raise CalibError(f"{name}: not a YAML file: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(values, Mapping):
        raise CalibError(f"{name}: expected a YAML mapping, found {type(values).__name__}")
    return values


def parse_yaml(text: str) -> Any:
    """Parse a YAML text; raise ValueError for one beyond the limits, and ruamel.yaml's error for a malformed one."""
    if len(text) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} characters, found {len(text)}")
    depth = nodes = 0
    # 1. The events name anchors and aliases without resolving them.
    for event in YAML(typ="safe", pure=True).parse(text):
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            raise ValueError(f"expected no anchors and aliases, found {str(event.anchor)[:40]}; write the values out")
        depth += isinstance(event, CollectionStartEvent)
        depth -= isinstance(event, CollectionEndEvent)
        nodes += isinstance(event, NodeEvent)
        if depth > MAX_DEPTH or nodes > MAX_NODES:
            raise ValueError(f"expected at most {MAX_DEPTH} levels and {MAX_NODES} values, found more")
        if isinstance(event, ScalarEvent) and len(event.value) > MAX_SCALAR:
            raise ValueError(f"expected values of at most {MAX_SCALAR} characters, found {len(event.value)}")
    # 2. The values.
    return YAML(typ="safe", pure=True).load(text)


def _cameras(values: Mapping[object, Any]) -> dict[str, ChainCamera]:
    """Return cam0, cam1, ... in ascending order."""
    names = [key for key in values if isinstance(key, str) and re.fullmatch(r"cam\d{1,3}", key)]
    if len(names) < 2:
        raise CalibError(f"expected two cameras (cam0, cam1), found {', '.join(names) or 'none'}")
    found, known = dict[str, ChainCamera](), ChainCamera.__struct_fields__
    for key in sorted(names, key=lambda key: int(key[3:])):
        if not isinstance(values[key], Mapping):
            raise CalibError(f"{key}: expected a table, found {shown(values[key])}")
        found[key] = convert(ChainCamera, {name: values[key][name] for name in known if name in values[key]}, (key,))
    return found


def _chain(cameras: Mapping[str, ChainCamera]) -> tuple[dict[str, Array], bool]:
    """Return transforms from one common frame into each camera; True if that frame is the rig's, False if cam0's."""
    poses = {
        key: transform_of(camera.T_cam_imu, f"{key}.T_cam_imu")
        for key, camera in cameras.items()
        if camera.T_cam_imu is not None
    }
    has_rig_frame = bool(poses)
    links = [
        (before, key, transform_of(cameras[key].T_cn_cnm1, f"{key}.T_cn_cnm1"))
        for before, key in pairwise(cameras)
        if int(key[3:]) == int(before[3:]) + 1 and cameras[key].T_cn_cnm1 is not None
    ]
    if not has_rig_frame:
        poses[next(iter(cameras))] = np.eye(4)
    for before, key, T_key_before in links:
        if before in poses and key in poses:
            _require_consistency(key, poses[key] @ se3.inverse(poses[before]), T_key_before)
        elif before in poses:
            poses[key] = T_key_before @ poses[before]
    for before, key, T_key_before in reversed(links):
        if key in poses and before not in poses:
            poses[before] = se3.inverse(T_key_before) @ poses[key]
    return poses, has_rig_frame


def _require_consistency(key: str, by_imu: Array, by_chain: Array) -> None:
    gap = se3.inverse(by_imu) @ by_chain
    distance, angle = np.linalg.norm(by_imu[:3, 3] - by_chain[:3, 3]), np.linalg.norm(se3.rotation_log(gap[:3, :3]))
    if distance > MAX_DISAGREEMENT_M or angle > MAX_DISAGREEMENT_RAD:
        raise CalibError(
            f"{key}: T_cam_imu and T_cn_cnm1 contradict each other by "
            f"{distance * 1e3:.1f} mm and {np.rad2deg(angle):.2f} deg; remove the one that is wrong"
        )


def _lower_and_upper(
    cameras: Mapping[str, ChainCamera],
    named: tuple[str, str],
    poses: dict[str, Array],
    warn: Callable[[str], None],
) -> tuple[str, str]:
    """Return the names of the lower and the upper camera: as named, else by topic, else by height in the rig frame."""
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
        pair = _by_topic(cameras) or _by_height(names, poses, warn)
    if pair[0] == pair[1]:
        raise CalibError(f"lower and upper must be two cameras, found {pair[0]} for both")
    return pair


def _by_topic(cameras: Mapping[str, ChainCamera]) -> tuple[str, str] | None:
    names = list(cameras)
    words = [set(re.split(r"[^a-z]+", camera.rostopic.lower())) for camera in cameras.values()]
    low = [bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words]
    if low[0] == low[1]:
        return None
    return (names[0], names[1]) if low[0] > low[1] else (names[1], names[0])


def _by_height(names: list[str], poses: dict[str, Array], warn: Callable[[str], None]) -> tuple[str, str]:
    heights = [float(se3.inverse(poses[name])[2, 3]) for name in names if name in poses]
    if len(heights) < 2 or abs(heights[0] - heights[1]) < MIN_HEIGHT_M:
        raise CalibError(
            f"neither topics nor heights identify the lower camera; name it, --lower {names[0]} or --lower {names[1]}"
        )
    low, up = (names[0], names[1]) if heights[0] < heights[1] else (names[1], names[0])
    warn(f"lower is {low} by z of the IMU, which must point up; if it does not, give --lower {up}")
    return low, up


def _camera(key: str, camera: ChainCamera) -> OmniCamera:
    """Return a camera of Kalibr's models omni, ds and eucm, and pinhole with radtan or equidistant distortion."""
    model, size = camera.camera_model, camera.resolution
    bends = {
        "omni": ("radtan", "none"),
        "ds": ("none",),
        "eucm": ("none",),
        "pinhole": ("radtan", "none", "equidistant"),
    }
    if model not in bends:
        raise CalibError(f"{key}.camera_model: expected {' or '.join(bends)}, found {model!r}")
    if not is_image_size(*size):
        raise CalibError(
            f"{key}.resolution: expected [width, height] in pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in all, "
            f"found {list(size)}"
        )
    if camera.distortion_model not in bends[model]:
        expected = " or ".join(bends[model])
        raise CalibError(f"{key}.distortion_model: expected {expected}, found {camera.distortion_model!r}")
    count = {"omni": 5, "pinhole": 4}.get(model, 6)
    if len(camera.intrinsics) != count:
        raise CalibError(f"{key}.intrinsics: expected {count} numbers, found {len(camera.intrinsics)}")
    terms = (0.0, 0.0, 0.0, 0.0) if camera.distortion_model == "none" else camera.distortion_coeffs
    if len(terms) != 4:
        raise CalibError(f"{key}.distortion_coeffs: expected 4 numbers, found {len(terms)}")
    *parameters, fu, fv, pu, pv = camera.intrinsics
    try:
        if model in ("ds", "eucm"):
            return lens_camera(model, parameters, (fu, fv), (pu, pv), size)
        if camera.distortion_model == "equidistant":
            return lens_camera("equidistant", terms, (fu, fv), (pu, pv), size)
        k1, k2, p1, p2 = terms
        return UnifiedCamera(parameters[0] if parameters else 0.0, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))
    except CalibError as error:
        raise CalibError(f"{key}: {error}") from error
