"""The table of one camera in a `rig.toml`, read and written: model, size, intrinsics and mask."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Collection, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.camera import Mask, OmniCamera
from calib.models.equirectangular import EquirectangularCamera
from calib.models.lens import LENS_KEYS, LensCamera, lens_camera, lens_parameters
from calib.models.names import model_name
from calib.models.ocam import (
    ASTIGMATISM_NAMES,
    DISTANCE_M,
    NO_WAVEFRONT,
    TANGENTIAL_NAMES,
    VIEWS,
    OcamCamera,
    View,
)
from calib.models.unified import OMNI_NAMES, UnifiedCamera
from calib.png import png
from calib.validation import ValidatedTable, read_bytes

# Signature, length and name of the first chunk, then width and height. Source: PNG 1.2, sections 3.1 and 4.1.1.
PNG_HEAD = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
PNG_FIRST_CHUNK = 8
# Length, name and CRC. Source: PNG 1.2, section 3.2.
PNG_CHUNK_BYTES = 12
# Chunks before the pixels, so that the search ends; programs write about a dozen.
MAX_PNG_CHUNKS = 1000
EMBEDDED = "data:image/png;base64,"
PINHOLE_KEYS = ("fu", "fv", "pu", "pv")
OCAM_KEYS = ("polynomial", "center_row", "center_column", "c", "d", "e")
# Optional terms of an ocam camera: tangential [1/px], secondary astigmatism [1/px^2]; files without them are read as 0.
OPTIONAL_KEYS = (*TANGENTIAL_NAMES, *ASTIGMATISM_NAMES)
# Optional wavefront [m], with the distance [m] at which the central model is exact.
WAVEFRONT_KEYS = ("wavefront", "distance_m")


def read_camera_table(
    table: ValidatedTable, folder: Path | None, others: Collection[str] = ()
) -> tuple[OmniCamera, Mask | None]:
    """Read camera and mask of a table; others: further keys that it may have; folder contains the mask's image."""
    model = table.choice("model", ("omni", "ocam", *LENS_KEYS, "equirectangular"))
    table.allow_only(("model", "size", "topic", "intrinsics", "mask", *others, *(["view"] if model == "ocam" else [])))
    camera: OmniCamera
    if model in ("omni", "ocam"):
        camera = _omni(table) if model == "omni" else _ocam(table)
    else:
        camera = _equirectangular(table) if model == "equirectangular" else _lens(table, model)
    return camera, _mask(table, folder) if table.has("mask") else None


def _omni(table: ValidatedTable) -> UnifiedCamera:
    values = table.table("intrinsics")
    values.allow_only(OMNI_NAMES)
    xi, fu, fv, pu, pv, k1, k2, p1, p2 = (values.number(key) for key in OMNI_NAMES)
    size = table.size("size")
    try:
        return UnifiedCamera(xi, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _lens(table: ValidatedTable, model: str) -> LensCamera:
    values, keys = table.table("intrinsics"), LENS_KEYS[model]
    values.allow_only((*keys, *PINHOLE_KEYS))
    parameters, (fu, fv, pu, pv) = [values.number(key) for key in keys], [values.number(key) for key in PINHOLE_KEYS]
    try:
        return lens_camera(model, parameters, (fu, fv), (pu, pv), table.size("size"))
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _equirectangular(table: ValidatedTable) -> EquirectangularCamera:
    values = table.table("intrinsics")
    values.allow_only(PINHOLE_KEYS)
    fu, fv, pu, pv = (values.number(key) for key in PINHOLE_KEYS)
    try:
        return EquirectangularCamera((fu, fv), (pu, pv), table.size("size"))
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _ocam(table: ValidatedTable) -> OcamCamera:
    values = table.table("intrinsics")
    values.allow_only((*OCAM_KEYS, *OPTIONAL_KEYS, *WAVEFRONT_KEYS))
    row, column, c, d, e = (values.number(key) for key in OCAM_KEYS[1:])
    p1, p2, s1, s2 = (values.number(key) if values.has(key) else 0.0 for key in OPTIONAL_KEYS)
    wavefront = values.numbers("wavefront", len(NO_WAVEFRONT)) if values.has("wavefront") else NO_WAVEFRONT
    distance_m = values.number("distance_m") if values.has("distance_m") else DISTANCE_M
    view: View = "mirror" if table.choice("view", VIEWS) == "mirror" else "direct"
    polynomial, size = values.numbers("polynomial"), table.size("size")
    try:
        return OcamCamera(polynomial, (row, column), (c, d, e), size, view, (p1, p2), (s1, s2), wavefront, distance_m)
    except CalibError as error:
        raise CalibError(f"{table.file}: {values.path}: {error}") from error


def _mask(table: ValidatedTable, folder: Path | None) -> Mask:
    values = table.table("mask")
    values.allow_only(("center", "inner_px", "outer_px", "image"))
    u, v = values.numbers("center", 2)
    inner = values.number("inner_px") if values.has("inner_px") else 0.0
    outer = values.number("outer_px") if values.has("outer_px") else float("inf")
    if not 0 <= inner < outer:
        values.fail("inner_px", "0 <= inner_px < outer_px")
    image = _mask_image(values, folder, table.size("size")) if values.has("image") else None
    return Mask((u, v), inner, outer, image)


def _mask_image(values: ValidatedTable, folder: Path | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the image of a mask (H, W), whose size is that of the camera's images.

    The header's size is checked first, since few bytes of a PNG can describe an image that fills the memory. An
    embedded image may come with a log of unknown origin: it must be a PNG. A file may have any format of OpenCV.
    """
    source = values.text("image")
    embedded = source.startswith(EMBEDDED)
    data = _embedded(values, source) if embedded else _beside(values, source, folder)
    if data.startswith(PNG_HEAD):
        _require_size(values, size, (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")))
        if _is_animated(data):
            values.fail("image", "a PNG without animation")
    elif embedded:
        values.fail("image", "a PNG")
    image = _decoded(values, data)
    _require_size(values, size, image.shape[::-1])
    return image


def _require_size(values: ValidatedTable, size: tuple[int, int], found: tuple[int, ...]) -> None:
    if found != size:
        raise CalibError(
            f"{values.file}: {values.path}.image: expected {size} pixels (width, height) like the "
            f"camera's images, found {found}"
        )


def _is_animated(data: bytes) -> bool:
    """True if a PNG has a chunk acTL before its pixels, or no pixels; OpenCV takes 10 bytes a pixel for animations."""
    offset = PNG_FIRST_CHUNK
    for _ in range(MAX_PNG_CHUNKS):
        name = data[offset + 4 : offset + 8]
        if name in (b"IDAT", b"acTL", b""):
            return name != b"IDAT"
        offset += int.from_bytes(data[offset : offset + 4], "big") + PNG_CHUNK_BYTES
    return True


def _decoded(values: ValidatedTable, data: bytes) -> NDArray[np.uint8]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    except cv2.error:
        image = None
    return values.fail("image", "an image") if image is None else image.astype(np.uint8, copy=False)


def _embedded(values: ValidatedTable, source: str) -> bytes:
    try:
        return base64.b64decode(source[len(EMBEDDED) :], validate=True)
    except (binascii.Error, ValueError):
        values.fail("image", "base64 after its prefix")


def _beside(values: ValidatedTable, source: str, folder: Path | None) -> bytes:
    if folder is None or "\0" in source:
        values.fail("image", "an embedded image, because there is no folder to read a file from")
    return read_bytes(folder / source)


def camera_text(name: str, camera: OmniCamera, topic: str) -> str:
    """Return the head of a camera's table; topic "" if unknown."""
    lines = ["", f"[{name}]", f'model = "{model_name(camera)}"', f"size = {[int(pixels) for pixels in camera.size]}"]
    if isinstance(camera, OcamCamera):
        lines.append(f'view = "{camera.view}"')
    if topic:
        lines.append(f"topic = {string_text(topic)}")
    return "\n".join(lines) + "\n"


def intrinsics_text(name: str, camera: OmniCamera) -> str:
    """Return the table of the intrinsics within a camera's table."""
    if isinstance(camera, UnifiedCamera):
        lines = _lines(OMNI_NAMES, (camera.xi, *camera.focal, *camera.center, *camera.distortion))
    elif isinstance(camera, OcamCamera):
        lines = _ocam_lines(camera)
    elif isinstance(camera, EquirectangularCamera):
        lines = _lines(PINHOLE_KEYS, (*camera.focal, *camera.center))
    elif isinstance(camera, LensCamera):
        keys = (*LENS_KEYS[model_name(camera)], *PINHOLE_KEYS)
        lines = _lines(keys, (*lens_parameters(camera), *camera.focal, *camera.center))
    else:
        raise CalibError(f"rig file: {name}: expected a camera of a known model, found {type(camera).__name__}")
    return "\n".join(["", f"[{name}.intrinsics]", *lines]) + "\n"


def _ocam_lines(camera: OcamCamera) -> list[str]:
    """Return the lines of an ocam camera's intrinsics; optional terms that are 0 are left out."""
    lines = [f"polynomial = [{', '.join(map(number_text, camera.polynomial))}]"]
    lines += _lines(OCAM_KEYS[1:], (*camera.center_row_column, *camera.affine))
    for keys, terms in ((TANGENTIAL_NAMES, camera.tangential), (ASTIGMATISM_NAMES, camera.astigmatism)):
        lines += _lines(keys, terms) if any(terms) else []
    if any(camera.wavefront):
        lines.append(f"wavefront = [{', '.join(map(number_text, camera.wavefront))}]")
        lines.append(f"distance_m = {number_text(camera.distance_m)}")
    return lines


def _lines(keys: Sequence[str], values: Sequence[float]) -> list[str]:
    return [f"{key} = {number_text(value)}" for key, value in zip(keys, values, strict=True)]


def mask_text(name: str, mask: Mask, image: str) -> str:
    """Return the table of the mask within a camera's table; image is the file name of its image, "" embeds it."""
    lines = [
        "",
        f"[{name}.mask]",
        f"center = [{number_text(mask.center[0])}, {number_text(mask.center[1])}]",
        f"inner_px = {number_text(mask.inner_px)}",
    ]
    if np.isfinite(mask.outer_px):
        lines.append(f"outer_px = {number_text(mask.outer_px)}")
    if mask.image is not None:
        embedded = EMBEDDED + base64.b64encode(png(mask.image)).decode()
        lines.append(f"image = {string_text(image or embedded)}")
    return "\n".join(lines) + "\n"


def number_text(value: float) -> str:
    """Return a number as TOML text that parses to the same bits; -0 is written as 0."""
    return repr(float(value) + 0.0)


def string_text(text: str) -> str:
    """Return a string as TOML text; CalibError for a file's name with bytes that are no UTF-8, as TOML holds none."""
    if any("\ud800" <= c <= "\udfff" for c in text):
        raise CalibError(f"a calibration file holds UTF-8 text, found {text!a}: give the file another name")
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
