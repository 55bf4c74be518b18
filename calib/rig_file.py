"""The rig as text: `rig.toml`, schema 1, strict. Rotations come back bit for bit, translations to a picometre.

Transforms are stored as T_rig_lower and T_rig_upper (p_rig = T_rig_lower @ p_lower): where the cameras are.
"""

from __future__ import annotations

import base64
import binascii
import os
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.camera import Array, Mask, OmniCamera
from calib.errors import CalibError
from calib.ocam import VIEWS, OcamCamera, View
from calib.rig import MountedCamera, Rig
from calib.strict import Table, decode, read_bytes
from calib.unified import UnifiedCamera

SCHEMA = 1
SIDES = ("lower", "upper")
# Translations are written to 1e-12 m: inverting twice rounds differently, a grid makes the text its own fixed point.
TRANSLATION_DECIMALS = 12
EMBEDDED = "data:image/png;base64,"
OMNI_KEYS = ("xi", "fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2")
OCAM_KEYS = ("polynomial", "center_row", "center_column", "c", "d", "e")


def read_rig(path: Path) -> Rig:
    """The rig in a `rig.toml`; a mask's picture is looked for beside it."""
    return parse_rig(read_bytes(path), path.parent, str(path))


def parse_rig(text: str | bytes, folder: Path | None = None, name: str = "rig.toml") -> Rig:
    """The rig in the text of a `rig.toml`; folder holds its mask pictures, None where only embedded ones can be had."""
    try:
        values = tomllib.loads(decode(text, name))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise CalibError(f"{name}: not a TOML file: {error}") from error
    table = Table(values, name)
    schema = table.values.get("schema")
    if type(schema) is not int or schema != SCHEMA:
        table.fail("schema", f"version {SCHEMA}")
    table.only(("schema", "T_base_rig", *SIDES))
    lower, upper = (table.table(side) for side in SIDES)
    T_base_rig = table.transform("T_base_rig") if table.has("T_base_rig") else np.eye(4)
    topics = [side.text("topic") if side.has("topic") else "" for side in (lower, upper)]
    mounted = [_mounted(side, folder, f"T_rig_{side.path}") for side in (lower, upper)]
    return Rig(mounted[0], mounted[1], T_base_rig, (topics[0], topics[1]))


def _mounted(table: Table, folder: Path | None, transform: str) -> MountedCamera:
    model = table.choice("model", ("omni", "ocam"))
    table.only(("model", "size", "topic", "intrinsics", "mask", transform, *(["view"] if model == "ocam" else [])))
    camera = _omni(table) if model == "omni" else _ocam(table)
    T_cam_rig = se3.inverse(table.transform(transform))
    return MountedCamera(camera, T_cam_rig, _mask(table, folder) if table.has("mask") else None)


def _omni(table: Table) -> UnifiedCamera:
    values = table.table("intrinsics")
    values.only(OMNI_KEYS)
    xi, fu, fv, pu, pv = (values.number(key) for key in OMNI_KEYS[:5])
    k1, k2, p1, p2 = (values.number(key) for key in OMNI_KEYS[5:])
    size = table.size("size")
    try:
        return UnifiedCamera(xi, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _ocam(table: Table) -> OcamCamera:
    values = table.table("intrinsics")
    values.only(OCAM_KEYS)
    row, column, c, d, e = (values.number(key) for key in OCAM_KEYS[1:])
    view: View = "mirror" if table.choice("view", VIEWS) == "mirror" else "direct"
    polynomial, size = values.numbers("polynomial"), table.size("size")
    try:
        return OcamCamera(polynomial, (row, column), (c, d, e), size, view)
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _mask(table: Table, folder: Path | None) -> Mask:
    values = table.table("mask")
    values.only(("center", "inner_px", "outer_px", "image"))
    u, v = values.numbers("center", 2)
    inner = values.number("inner_px") if values.has("inner_px") else 0.0
    outer = values.number("outer_px") if values.has("outer_px") else float("inf")
    if not 0 <= inner < outer:
        values.fail("inner_px", "0 <= inner_px < outer_px")
    image = _mask_image(values, folder) if values.has("image") else None
    if image is not None and image.shape[::-1] != table.size("size"):
        raise CalibError(f"{table.file}: {values.path}.image: expected {table.size('size')} pixels (width, height) "
                         f"like the camera's pictures, found {image.shape[::-1]}")
    return Mask((u, v), inner, outer, image)


def _mask_image(values: Table, folder: Path | None) -> NDArray[np.uint8]:
    source = values.text("image")
    data = _embedded(values, source) if source.startswith(EMBEDDED) else _beside(values, source, folder)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    except cv2.error:
        image = None
    return values.fail("image", "a picture") if image is None else image.astype(np.uint8, copy=False)


def _embedded(values: Table, source: str) -> bytes:
    try:
        return base64.b64decode(source[len(EMBEDDED):], validate=True)
    except (binascii.Error, ValueError):
        values.fail("image", "base64 after its prefix")


def _beside(values: Table, source: str, folder: Path | None) -> bytes:
    if folder is None or "\0" in source:
        values.fail("image", "an embedded picture, as there is no folder to look for a file in")
    return read_bytes(folder / source)


def write_rig(path: Path, rig: Rig) -> None:
    """Write `rig.toml`, and a mask's picture beside it as `<stem>.lower.png` or `<stem>.upper.png`."""
    images: dict[str, str] = {}
    for side, mounted in zip(SIDES, (rig.lower, rig.upper), strict=True):
        if mounted.mask is not None and mounted.mask.image is not None:
            images[side] = f"{path.stem}.{side}.png"
            write_file(path.with_name(images[side]), _png(mounted.mask.image))
    write_file(path, rig_toml(rig, images).encode())


def write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; a pipe or a device is written as it is."""
    target = Path(os.path.realpath(path))
    try:
        _write_whole(target, data)
    except OSError as error:
        raise CalibError(f"{path}: cannot be written: {error.strerror or error}") from error


def _write_whole(target: Path, data: bytes) -> None:
    whole = target.is_file() or not target.exists()
    temporary = target.with_name(f".{target.name}.{os.getpid()}") if whole else target
    try:
        temporary.write_bytes(data)
        temporary.replace(target)
    except OSError:
        if whole:
            with suppress(OSError):
                temporary.unlink()
        raise


def _png(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def rig_toml(rig: Rig, images: Mapping[str, str] | None = None) -> str:
    """The text of `rig.toml`; images names mask pictures by side, one that is not named is embedded."""
    parts = [f"schema = {SCHEMA}\nT_base_rig = {_matrix(rig.T_base_rig)}\n"]
    for side, mounted, topic in zip(SIDES, (rig.lower, rig.upper), rig.topics, strict=True):
        parts.append(_camera_text(side, mounted.camera, topic))
        parts.append(f"T_rig_{side} = {_matrix(_on_grid(se3.inverse(mounted.T_cam_rig)))}\n")
        parts.append(_intrinsics_text(side, mounted.camera))
        if mounted.mask is not None:
            parts.append(_mask_text(side, mounted.mask, (images or {}).get(side, "")))
    return "".join(parts)


def _camera_text(side: str, camera: OmniCamera, topic: str) -> str:
    lines = ["", f"[{side}]", f'model = "{"ocam" if isinstance(camera, OcamCamera) else "omni"}"',
             f"size = {[int(pixels) for pixels in camera.size]}"]
    if isinstance(camera, OcamCamera):
        lines.append(f'view = "{camera.view}"')
    if topic:
        lines.append(f"topic = {_string(topic)}")
    return "\n".join(lines) + "\n"


def _intrinsics_text(side: str, camera: OmniCamera) -> str:
    if isinstance(camera, UnifiedCamera):
        values = (camera.xi, *camera.focal, *camera.center, *camera.distortion)
        named = [f"{key} = {_float(value)}" for key, value in zip(OMNI_KEYS, values, strict=True)]
    elif isinstance(camera, OcamCamera):
        numbers = (*camera.center_row_column, *camera.affine)
        named = [f"polynomial = [{', '.join(map(_float, camera.polynomial))}]"]
        named += [f"{key} = {_float(value)}" for key, value in zip(OCAM_KEYS[1:], numbers, strict=True)]
    else:
        raise CalibError(f"rig file: {side}: expected an omni or ocam camera, found {type(camera).__name__}")
    return "\n".join(["", f"[{side}.intrinsics]", *named]) + "\n"


def _mask_text(side: str, mask: Mask, image: str) -> str:
    lines = ["", f"[{side}.mask]", f"center = [{_float(mask.center[0])}, {_float(mask.center[1])}]",
             f"inner_px = {_float(mask.inner_px)}"]
    if np.isfinite(mask.outer_px):
        lines.append(f"outer_px = {_float(mask.outer_px)}")
    if mask.image is not None:
        embedded = EMBEDDED + base64.b64encode(_png(mask.image)).decode()
        lines.append(f"image = {_string(image or embedded)}")
    return "\n".join(lines) + "\n"


def _on_grid(T: Array) -> Array:
    return se3.transform(T[:3, :3], np.round(T[:3, 3], TRANSLATION_DECIMALS))


def _matrix(T: Array) -> str:
    rows = [f"    [{', '.join(map(_float, row))}]," for row in T]
    return "\n".join(["[", *rows, "]"])


def _float(value: float) -> str:
    return repr(float(value) + 0.0)


def _string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
