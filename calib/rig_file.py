"""The rig as text: `rig.toml`, schema 1, strict. Rotations are restored exactly, translations to a picometre.

Transforms are stored as T_rig_lower and T_rig_upper (p_rig = T_rig_lower @ p_lower): the poses of the cameras. The
optional table [covariance] has a version of its own: see covariance_table.py and rig_covariance.py. The optional table
[times] has the times of exposure that `omnid calibrate drive` found: upper_delay_s, line_time_s. The table [refined],
which earlier versions of omnid wrote, is ignored.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from calib import se3
from calib.camera_table import camera_text, intrinsics_text, mask_text, number_text, read_camera_table
from calib.covariance_table import covariance_text, read_covariance
from calib.errors import CalibError
from calib.models.camera import Array
from calib.png import png
from calib.rig import MountedCamera, Rig, ShutterTimes
from calib.validation import ValidatedTable, read_bytes, require_schema, toml_table

SCHEMA = 1  # the first: it rises when an earlier program would misread the file
SIDES = ("lower", "upper")
LOG_BEGINNINGS = (b"\x89MCAP", b"SQLite format 3", b"#ROSBAG")
OTHER_CALIBRATIONS = (".yaml", ".yml", ".json", ".txt")  # as of Kalibr, Basalt, OCamCalib
TIME_KEYS = ("upper_delay_s", "line_time_s")
# Translations are rounded to 1e-12 m: two inversions round differently, and rounding makes the text reproducible.
TRANSLATION_DECIMALS = 12


def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read the rig of a `rig.toml`; a mask's image is read from the same folder. CalibError says what to do."""
    path = Path(path)
    if not path.exists():
        raise CalibError(f"{path}: there is no such rig: `omnid calibrate import` or `omnid calibrate rig` makes one")
    text = read_bytes(path)
    if text.startswith(LOG_BEGINNINGS):
        raise CalibError(
            f"{path}: a log, but a rig.toml was expected: without --rig the one attached to the log is used"
        )
    if path.suffix in OTHER_CALIBRATIONS:
        raise CalibError(
            f"{path}: a rig.toml was expected: `omnid calibrate import {path} -o rig.toml` makes one of this file"
        )
    return parse_rig(text, path.parent, str(path))


def parse_rig(text: str | bytes, folder: Path | None = None, name: str = "rig.toml") -> Rig:
    """Parse the rig of a `rig.toml`'s text; folder contains its mask images, None permits embedded ones only."""
    table = toml_table(text, name)
    require_schema(table, SCHEMA)
    table.allow_only(("schema", "T_base_rig", "covariance", "times", "refined", *SIDES))
    lower, upper = (table.table(side) for side in SIDES)
    T_base_rig = table.transform("T_base_rig") if table.has("T_base_rig") else np.eye(4)
    topics = [side.text("topic") if side.has("topic") else "" for side in (lower, upper)]
    mounted = [_mounted(side, folder, f"T_rig_{side.path}") for side in (lower, upper)]
    cameras = (mounted[0].camera, mounted[1].camera)
    covariance = read_covariance(table.table("covariance"), cameras) if table.has("covariance") else None
    times = _times(table.table("times")) if table.has("times") else ShutterTimes()
    return Rig(mounted[0], mounted[1], T_base_rig, (topics[0], topics[1]), covariance, times)


def _times(table: ValidatedTable) -> ShutterTimes:
    table.allow_only(TIME_KEYS)
    delay_s, line_s = (table.number(key) if table.has(key) else 0.0 for key in TIME_KEYS)
    try:
        return ShutterTimes(delay_s, line_s)
    except CalibError as error:
        raise CalibError(f"{table.file}: {table.path}: {error}") from error


def _mounted(table: ValidatedTable, folder: Path | None, transform: str) -> MountedCamera:
    camera, mask = read_camera_table(table, folder, [transform])
    return MountedCamera(camera, se3.inverse(table.transform(transform)), mask)


def write_rig(path: Path, rig: Rig) -> None:
    """Write `rig.toml`, and mask images in the same folder as `<stem>.lower.png` and `<stem>.upper.png`."""
    masks = {side: mounted.mask for side, mounted in zip(SIDES, (rig.lower, rig.upper), strict=True)}
    painted = {side: mask.image for side, mask in masks.items() if mask is not None and mask.image is not None}
    images = {side: f"{path.stem}.{side}.png" for side in painted}
    text = rig_toml(rig, images).encode()
    for side, image in painted.items():
        write_file(path.with_name(images[side]), png(image))
    write_file(path, text)


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically; a pipe or a device is written directly."""
    target = Path(os.path.realpath(path))
    try:
        _write_whole(target, data)
    except OSError as error:
        raise CalibError(f"{path}: cannot be written: {error.strerror or error}") from error


def _write_whole(target: Path, data: bytes) -> None:
    if target.exists() and not target.is_file():
        target.write_bytes(data)
        return
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)
        with open(temporary, "xb", opener=_open_no_link) as file:
            file.write(data)
        temporary.replace(target)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def rig_toml(rig: Rig, images: Mapping[str, str] | None = None) -> str:
    """Return the text of a `rig.toml`; images: file names of mask images by side, others are embedded."""
    parts = [f"schema = {SCHEMA}\n"]
    if not np.array_equal(rig.T_base_rig, np.eye(4)):  # else it is not stated
        parts.append(f"T_base_rig = {_matrix(rig.T_base_rig)}\n")
    for side, mounted, topic in zip(SIDES, (rig.lower, rig.upper), rig.topics, strict=True):
        parts.append(camera_text(side, mounted.camera, topic))
        parts.append(f"T_rig_{side} = {_matrix(_on_grid(se3.inverse(mounted.T_cam_rig)))}\n")
        parts.append(intrinsics_text(side, mounted.camera))
        if mounted.mask is not None:
            parts.append(mask_text(side, mounted.mask, (images or {}).get(side, "")))
    if rig.times != ShutterTimes():
        values = (rig.times.upper_delay_s, rig.times.line_time_s)
        parts.append("\n[times]\n")
        parts += [f"{key} = {number_text(value)}\n" for key, value in zip(TIME_KEYS, values, strict=True)]
    if rig.covariance is not None:
        parts.append(covariance_text(rig.covariance))
    return "".join(parts)


def _on_grid(T: Array) -> Array:
    return se3.transform(T[:3, :3], np.round(T[:3, 3], TRANSLATION_DECIMALS))


def _matrix(T: Array) -> str:
    rows = [f"    [{', '.join(map(number_text, row))}]," for row in T]
    return "\n".join(["[", *rows, "]"])
