"""Read and write `rig.toml`, schema 1, strictly. Rotations are restored exactly, translations to a picometre.

Transforms are stored as T_rig_lower and T_rig_upper (p_rig = T_rig_lower @ p_lower): the poses of the cameras. The
optional table [covariance] has its own version: see rig.py. The optional table [times] holds the exposure times
that `omnid calibrate drive` found: upper_delay_s, line_time_s.
"""

from __future__ import annotations

import base64
import binascii
import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import cv2
import numpy as np
from msgspec import Struct, defstruct
from msgspec.structs import asdict
from numpy.typing import NDArray

from calib import se3
from calib.atomic_file import replacement
from calib.errors import CalibError, within
from calib.models.camera import Mask, OmniCamera
from calib.models.names import MODELS, camera_of, model_name, names_of, values_of
from calib.models.ocam import DISTANCE_M, OcamCamera, View
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig import DECIMALS, SIDES, TRANSFORM_NAMES, MountedCamera, Rig, RigCovariance, ShutterTimes
from calib.typed_toml import convert, shown, table_of, toml_value
from calib.validation import read_bytes, require_image_size, transform_of

# Version of the file and of its table [covariance]: it rises when an earlier program would misread them.
SCHEMA: Final = 1
EMBEDDED: Final = "data:image/png;base64,"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_HEAD: Final = struct.Struct(">8s8xII")  # signature, width, height (PNG 1.2, 4.1.1)

# 1. The tables of the file.
Size: TypeAlias = tuple[int, int]
Matrix: TypeAlias = tuple[tuple[float, ...], ...]
Model: TypeAlias = Literal["omni", "ocam", "ds", "equidistant", "equirectangular"]


class OcamIntrinsics(Struct, frozen=True):
    """OCamCalib's numbers, with optional tangential terms [1/px], astigmatism [1/px^2], and wavefront [m]."""

    polynomial: tuple[float, ...]
    center_row: float
    center_column: float
    c: float
    d: float
    e: float
    p1: float | None = None
    p2: float | None = None
    s1: float | None = None
    s2: float | None = None
    wavefront: tuple[float, float, float, float, float] | None = None
    distance_m: float | None = None  # at which the central model is exact


INTRINSICS: Final[Mapping[str, type[Struct]]] = {
    "ocam": OcamIntrinsics,
    **{
        model: defstruct(f"{model}_intrinsics", [(name, float) for name in names_of(model)])
        for model in MODELS
        if model != "ocam"
    },
}


class MaskTable(Struct, frozen=True):
    """The ring between two circles, and an embedded image of the camera's size."""

    center: tuple[float, float]
    inner_px: float = 0.0
    outer_px: float | None = None
    image: str | None = None


class CameraTable(Struct, frozen=True):
    """One camera; intrinsics: see INTRINSICS."""

    model: Model
    size: Size
    intrinsics: dict[str, Any]
    view: View | None = None  # of an ocam camera
    topic: str = ""
    T_rig_lower: Matrix | None = None
    T_rig_upper: Matrix | None = None
    mask: MaskTable | None = None


class CovarianceTable(Struct, frozen=True):
    """Names, standard deviations, and correlations: row k has the k numbers left of the diagonal."""

    version: int
    parameters: tuple[str, ...]
    sigma: tuple[float, ...]
    correlation: Matrix


class RigTable(Struct, frozen=True):
    """The whole file."""

    schema: int
    lower: CameraTable
    upper: CameraTable
    T_base_rig: Matrix | None = None
    times: ShutterTimes = ShutterTimes()
    covariance: CovarianceTable | None = None


# 2. Reading.
def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read the rig of a `rig.toml`. CalibError says what to do."""
    path = Path(path)
    if not path.exists():
        raise CalibError(f"{path}: there is no such rig: `omnid calibrate import` or `omnid calibrate rig` makes one")
    return parse_rig(read_bytes(path), str(path))


def parse_rig(text: str | bytes, name: str = "rig.toml") -> Rig:
    """Parse the rig of a `rig.toml`'s text."""
    with within(f"{name}: "):
        values = table_of(text.encode() if isinstance(text, str) else text)
        _require_version("schema", values.get("schema"))  # first, as another one has other keys
        table = convert(RigTable, values)
        lower, upper = (_mounted(side, getattr(table, side)) for side in SIDES)
        return Rig(
            lower,
            upper,
            np.eye(4) if table.T_base_rig is None else transform_of(table.T_base_rig, "T_base_rig"),
            (table.lower.topic, table.upper.topic),
            None if table.covariance is None else _covariance(table.covariance, (lower, upper)),
            table.times,
        )


def _require_version(key: str, found: object) -> None:
    if type(found) is not int or found != SCHEMA:
        raise CalibError(f"{key}: expected version {SCHEMA}, found {'nothing' if found is None else shown(found)}")


def _mounted(side: str, table: CameraTable) -> MountedCamera:
    """Return the camera of a table."""
    T_rig_cam, other = table.T_rig_lower, table.T_rig_upper
    if side == "upper":
        T_rig_cam, other = other, T_rig_cam
    if other is not None:
        raise CalibError(f"{side}: expected T_rig_{side}, found that of the other camera")
    require_image_size(f"{side}.size", *table.size)
    if (table.view is not None) != (table.model == "ocam"):
        raise CalibError(f"{side}.view: expected mirror or direct for the model ocam, and no view for others")
    intrinsics = convert(INTRINSICS[table.model], table.intrinsics, (side, "intrinsics"))
    with within(f"{side}.intrinsics: "):
        camera = _camera(table, intrinsics)
    mask = None if table.mask is None else _mask(f"{side}.mask", table.mask, table.size)
    return MountedCamera(camera, se3.inverse(transform_of(T_rig_cam, f"{side}.T_rig_{side}")), mask)


def _camera(table: CameraTable, i: Struct) -> OmniCamera:
    """Return the camera of a table and its intrinsics."""
    values = {name: value for name, value in asdict(i).items() if value is not None}
    if not isinstance(i, OcamIntrinsics):
        return camera_of(table.model, values, table.size)
    distance_m = values.pop("distance_m", DISTANCE_M)
    values |= {f"a{power}": value for power, value in enumerate(values.pop("polynomial"))}
    values |= dict(zip(WAVEFRONT_NAMES, values.pop("wavefront", ()), strict=False))
    return camera_of("ocam", values, table.size, table.view or "mirror", distance_m)


def _mask(path: str, table: MaskTable, size: Size) -> Mask:
    outer_px = np.inf if table.outer_px is None else table.outer_px
    if not 0 <= table.inner_px < outer_px:
        raise CalibError(f"{path}.inner_px: expected 0 <= inner_px < outer_px, found {table.inner_px:g}")
    with within(f"{path}.image: "):
        image = None if table.image is None else _mask_image(table.image, size)
    return Mask(table.center, table.inner_px, float(outer_px), image)


def _mask_image(source: str, size: Size) -> NDArray[np.uint8]:
    """Return the image of a mask (H, W), whose size is that of the camera's images."""
    if not source.startswith(EMBEDDED):
        raise CalibError(f"expected an embedded image, which begins with {EMBEDDED}")
    try:
        data = base64.b64decode(source[len(EMBEDDED) :], validate=True)
    except (binascii.Error, ValueError):
        raise CalibError("expected base64 after its prefix") from None
    # The size is checked before the image is unpacked: a short file may be a gigabyte of pixels.
    signature, *found = _PNG_HEAD.unpack_from(data.ljust(_PNG_HEAD.size))
    if signature == _PNG and tuple(found) != size:
        raise CalibError(f"expected {size} pixels (width, height) like the camera's images, found {tuple(found)}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if signature == _PNG else None
    except cv2.error:
        image = None
    if image is None or image.shape[::-1] != size:
        raise CalibError("expected an image")
    return image.astype(np.uint8, copy=False)


def _covariance(table: CovarianceTable, cameras: Sequence[MountedCamera]) -> RigCovariance:
    """Return the covariance of the parameters of both cameras and of the transform between them."""
    _require_version("covariance.version", table.version)
    known, names = {*TRANSFORM_NAMES}, table.parameters
    for side, mounted in zip(SIDES, cameras, strict=True):
        known |= {f"{side} {name}" for name in values_of(mounted.camera)}
    if not names or not known.issuperset(names):
        raise CalibError(
            "covariance.parameters: expected names of the cameras' parameters and of the transform's, found "
            f"{shown(list(names))}"
        )
    if [len(row) for row in table.correlation] != [*range(len(names))]:
        raise CalibError(
            f"covariance.correlation: expected {len(names)} rows of 0, 1, 2 ... numbers, those left of the diagonal"
        )
    correlation = np.eye(len(names))
    for k, row in enumerate(table.correlation):
        correlation[k, :k] = correlation[:k, k] = row
    with within("covariance: "):
        return RigCovariance(names, np.array(table.sigma), correlation)


# 3. Writing.
def write_rig(path: Path, rig: Rig) -> None:
    """Write `rig.toml`, with the images of masks within it. Raises CalibError if that is impossible."""
    try:
        with replacement(path) as partial:
            partial.write_text(rig_toml(rig), "utf-8")
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise CalibError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W) or (H, W, 3) uint8 as the bytes of a PNG."""
    return cv2.imencode(".png", image)[1].tobytes()


def rig_toml(rig: Rig) -> str:
    """Return the text of a `rig.toml`."""
    text = f"schema = {SCHEMA}\n"
    if not np.array_equal(rig.T_base_rig, np.eye(4)):  # else it is not stated
        text += f"T_base_rig = {toml_value(rig.T_base_rig.tolist())}\n"
    for (side, mounted), topic in zip(rig.sides, rig.topics, strict=True):
        camera, T_rig_cam = mounted.camera, se3.inverse(mounted.T_cam_rig)
        # Two inversions round differently, and rounding makes the text reproducible.
        T_rig_cam[:3, 3] = np.round(T_rig_cam[:3, 3], DECIMALS)
        head = {
            "model": model_name(camera),
            "size": [int(pixels) for pixels in camera.size],
            "view": camera.view if isinstance(camera, OcamCamera) else None,
            "topic": topic or None,
            f"T_rig_{side}": T_rig_cam.tolist(),
        }
        text += _table_text(side, head) + _table_text(f"{side}.intrinsics", _intrinsics(camera))
        if mounted.mask is not None:
            mask, image = mounted.mask, None
            if mask.image is not None:
                image = EMBEDDED + base64.b64encode(png(mask.image)).decode()
            outer_px = mask.outer_px if np.isfinite(mask.outer_px) else None
            text += _table_text(f"{side}.mask", asdict(MaskTable(mask.center, mask.inner_px, outer_px, image)))
    if rig.times != ShutterTimes():
        text += _table_text("times", asdict(rig.times))
    if (covariance := rig.covariance) is not None:
        correlation = tuple(tuple(row[:k]) for k, row in enumerate(covariance.correlation.tolist()))
        sigmas = tuple(covariance.sigmas.tolist())
        table = CovarianceTable(SCHEMA, covariance.names, sigmas, correlation)
        text += _table_text("covariance", asdict(table))
    return text


def _intrinsics(camera: OmniCamera) -> Mapping[str, object]:
    """Return the intrinsics of a camera by their keys; optional terms of an ocam camera that are 0 are None."""
    if not isinstance(camera, OcamCamera):
        return values_of(camera)
    p1, p2 = camera.tangential if any(camera.tangential) else (None, None)
    s1, s2 = camera.astigmatism if any(camera.astigmatism) else (None, None)
    a, b, x, y, s = camera.wavefront
    waves = ((a, b, x, y, s), camera.distance_m) if any(camera.wavefront) else (None, None)
    return asdict(OcamIntrinsics(camera.polynomial, *camera.center_row_column, *camera.affine, p1, p2, s1, s2, *waves))


def _table_text(name: str, values: Mapping[str, object]) -> str:
    """Return a table of TOML without the keys whose value is None."""
    lines = [f"{key} = {toml_value(value)}" for key, value in values.items() if value is not None]
    return "\n".join(["", f"[{name}]", *lines]) + "\n"
