"""Files of one camera: OCamCalib, ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal (VINS); and rigs of two.

The transform between two cameras is in their files (EuRoC's T_BS, the rectification of a stereo camera_info), or it has
a file, or it is straight up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.foreign_models import camera_of, camera_of_lists
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import View
from calib.ocam_file import is_ocam, parse_ocam
from calib.rig import Rig
from calib.rig_frame import mounting_notes, rig_between
from calib.text_files import MAX_JSON_BYTES, load_mapping
from calib.typed_toml import shown
from calib.validation import Warn, read_bytes, silent, transform_of

# Keys of one thing, in camera_info YAML, in messages of ROS 1 and of ROS 2.
MATRIX: Final = ("camera_matrix", "K", "k", "Camera_Matrix")
TERMS: Final = ("distortion_coefficients", "D", "d", "distortion_coeffs", "Distortion_Coefficients")
RECTIFICATION, PROJECTION = ("rectification_matrix", "R", "r"), ("projection_matrix", "P", "p")
WIDTH: Final = ("image_width", "width", "image_Width")
HEIGHT: Final = ("image_height", "height", "image_Height")
# camodocal's models: the tables and names of their numbers, and ours.
CAMODOCAL: Final[Mapping[str, tuple[str, dict[str, str]]]] = {
    "MEI": ("omni", {"xi": "xi", "gamma1": "fu", "gamma2": "fv", "u0": "pu", "v0": "pv"}),
    "KANNALA_BRANDT": (
        "equidistant",
        {"k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4", "mu": "fu", "mv": "fv", "u0": "pu", "v0": "pv"},
    ),
    "PINHOLE": ("pinhole", {"fx": "fu", "fy": "fv", "cx": "pu", "cy": "pv"}),
}


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
        T_lower_upper = T_lower_upper if T_lower_upper[:3, 3].any() else None
    if T_lower_upper is None:
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
    if not is_named or is_ocam(data, name):
        return CameraFile(parse_ocam(data, view, name))
    values = load_mapping(data, name)
    read = _reader(values)
    if read is None:
        raise CalibError(
            f"{name}: expected one camera as ROS's camera_info, OpenCV, EuRoC's sensor.yaml, camodocal or OCamCalib "
            f"write it, found the keys {shown(sorted(values))}"
        )
    try:
        return read(values, lambda line: warn(f"{name}: {line}"))
    except (CalibError, ValueError, TypeError) as error:
        raise error if str(error).startswith(name) else CalibError(f"{name}: {error}") from error


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
    size = _whole(values, WIDTH), _whole(values, HEIGHT)
    model = str(values.get("distortion_model", "plumb_bob") or "plumb_bob")
    if values.get("fisheye_model"):  # of OpenCV's sample
        model = "fisheye"
    camera = camera_of_lists(("pinhole", model), [K[0], K[4], K[2], K[5]], terms.tolist(), size, warn)
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
    camera = camera_of_lists(
        names,
        _numbers(values, ("intrinsics",), tuple(range(4, 7))).tolist(),
        _numbers(values, TERMS, tuple(range(15))).tolist(),
        (int(width), int(height)),
        warn,
    )
    return CameraFile(camera, transform_of(values["T_BS"], "T_BS", warn))


def _camodocal(values: Mapping[str, Any], warn: Warn) -> CameraFile:
    """Return the camera of a file of camodocal, as VINS-Mono and VINS-Fusion use it."""
    kind = str(values["model_type"]).upper()
    if kind not in CAMODOCAL:
        raise CalibError(
            f"model_type: expected {', '.join(CAMODOCAL)}, found {shown(values['model_type'])}: of SCARAMUZZA, import "
            "the calib_results.txt of OCamCalib"
        )
    model, names = CAMODOCAL[kind]
    found = dict[str, float]()
    for table in ("mirror_parameters", "distortion_parameters", "projection_parameters"):
        part = values.get(table)
        for key, value in (part if isinstance(part, Mapping) else {}).items():
            found[names.get(str(key), str(key))] = float(value)
    missing = [key for key, ours in names.items() if ours not in found]
    if missing:
        raise CalibError(f"{kind}: expected {', '.join(missing)} among its parameters, found {shown(sorted(found))}")
    return CameraFile(camera_of(model, found, (_whole(values, WIDTH), _whole(values, HEIGHT)), warn))


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


def _whole(values: Mapping[str, Any], keys: tuple[str, ...]) -> int:
    """Return the whole number under the first of several keys that is there."""
    return int(_numbers(values, keys, (1,))[0])
