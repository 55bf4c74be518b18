"""Trajectories in the TUM format: one pose a line, `t x y z qx qy qz qw` (seconds, metres, unit quaternion).

A head that names the columns, as `#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...` of EuRoC's CSV files, states the
order of the quaternion and the unit of the stamps.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from io import BytesIO, TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError

Array = NDArray[np.float64]
FILE_LIMIT_BYTES: Final = 1 << 28  # about 2.5 million poses, days of driving; a log given by mistake is refused
POSITION_LIMIT_M: Final = 1e9  # Largest coordinate, so that squares and sums cannot overflow.
STAMP_LIMIT_NS: Final = 1 << 62  # Largest stamp, so that the difference of two stamps fits int64.
_DECIMALS: Final = 9  # nanoseconds, nanometres
_AXES: Final = ["x", "y", "z"]
_QUATERNION: Final = [*_AXES, "w"]
# The power of ten from a stamp to nanoseconds, by its unit. Where the file does not name the unit, it is the first that
# gives a time within the limit.
_TO_NANOSECONDS: Final = {"s": 9, "ms": 6, "us": 3, "ns": 0}
_SHOWN: Final = 60  # characters of a wrong line


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses T_odom_rig (or T_world_rig) over time; stamps increase strictly; both arrays are read-only."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T: Array  # (N, 4, 4)


def parts(T: Array) -> tuple[Array, Array]:
    """Return rotations (..., 3, 3) and positions (..., 3) of transforms (..., 4, 4)."""
    return T[..., :3, :3], T[..., :3, 3]


def read_tum(path: str | Path) -> Trajectory:
    """Return the trajectory of a TUM file, sorted by stamp.

    Blank lines and everything after `#` are skipped; quaternions are normalised. A repeated stamp is refused: two poses
    at one time contradict each other. Raises OmnidError that names the file, the line and what was found.
    """
    # 1. Stamp, line and numbers of each pose.
    found, line, order, unit = list[tuple[int, int, list[float]]](), 0, _QUATERNION, ""
    try:
        for line, content in enumerate(_lines(Path(path)), start=1):
            data, _, comment = content.partition("#")
            words = _words(data)
            is_head = len(words) > 1 and not any(re.match(r"[-+.]?[0-9]", word) for word in words)
            if words and (found or not is_head):
                unit = unit or _unit_of(words[0])
                # Tables may have more columns, such as velocities.
                stamp_ns, pose = _row(words[:8] if re.search("[,;]", data) else words, unit)
                found.append((stamp_ns, line, pose))
            elif not found:
                order, unit = _columns(data if words else comment) or (order, unit)
    except ValueError as error:
        raise OmnidError(f"{path}, line {line}: {error}") from error
    if not found:
        raise OmnidError(f"{path}: no pose found: expected lines 't x y z qx qy qz qw'")
    # 2. Sorted by stamp, each once.
    found.sort(key=lambda pose: pose[0])
    for (before_ns, first, _), (stamp_ns, second, _) in pairwise(found):
        if before_ns == stamp_ns:
            raise OmnidError(
                f"{path}, line {second}: expected each stamp once, found that of line {first} again: remove one of the "
                "two"
            )
    xyz, q = np.split(np.array([pose for *_, pose in found]), [len(_AXES)], axis=1)
    q = q[:, [order.index(name) for name in _QUATERNION]]
    # The division keeps squares in se3 from overflowing.
    T = se3.transform(se3.rotation(q / np.abs(q).max(axis=1, keepdims=True)), xyz)
    stamps_ns = np.array([stamp_ns for stamp_ns, *_ in found], np.int64)
    stamps_ns.setflags(write=False)
    T.setflags(write=False)
    return Trajectory(stamps_ns, T)


def tum_row(stamp_ns: int, T: Array) -> str:
    """Return a TUM line without newline: 9 decimals, w >= 0, never '-0', so the same bytes for the same pose."""
    sign, (whole_s, rest_ns) = "-" if stamp_ns < 0 else "", divmod(abs(int(stamp_ns)), 10**9)
    R, xyz = parts(T)
    q = se3.quaternion(R)
    # The last component that prints as non-zero (w, else z, y, x) is positive.
    visible = np.round(q, _DECIMALS)[np.round(q, _DECIMALS) != 0.0]
    pose = np.round(np.concatenate([xyz, -q if visible.size and visible[-1] < 0.0 else q]), _DECIMALS) + 0.0
    return " ".join([f"{sign}{whole_s}.{rest_ns:09d}", *(f"{float(value):.{_DECIMALS}f}" for value in pose)])


def _lines(path: Path) -> TextIOWrapper:
    """Return the lines of a text, in UTF-16 if it begins with its byte order mark; comments may have any encoding."""
    try:
        with path.open("rb") as file:
            raw = file.read(FILE_LIMIT_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the trajectory: {getattr(error, 'strerror', None) or error}") from error
    if len(raw) > FILE_LIMIT_BYTES:
        raise OmnidError(f"{path}: expected at most {FILE_LIMIT_BYTES >> 20} MiB: split the file")
    is_wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return TextIOWrapper(BytesIO(raw), "utf-16" if is_wide else "utf-8-sig", errors="replace")


def _words(data: str) -> list[str]:
    """Return the words of a line, separated by spaces, commas or semicolons; numbers may have decimal commas."""
    data = data.replace('"', " ").replace(";", " ")
    words = data.split()
    if len(words) > 1 and all(re.fullmatch(r"[-+]?\d+,\d+", word) for word in words):
        return [word.replace(",", ".") for word in words]
    return data.replace(",", " ").split()


def _columns(head: str) -> tuple[list[str], str] | None:
    """Return the order of the quaternion and the unit of the stamps; None unless time, position, quaternion follow."""
    unit = re.match(r"[^,]*\[(s|ms|us|ns)\]", head)
    names = _words(re.sub(r"\[[^\]]*\]", "", head).lower())
    axes = [name[-1] for name in names[1:8]]
    order = axes[len(_AXES) :]
    if axes[: len(_AXES)] != _AXES or sorted(order) != sorted(_QUATERNION):
        return None
    return order, unit[1] if unit else ""


def _unit_of(stamp: str) -> str:
    """Return the unit of a stamp by its size; whole numbers of ten digits or more may be other units than seconds."""
    whole = int(stamp) if re.fullmatch(r"\d{10,19}", stamp) else 0
    return next((unit for unit, places in _TO_NANOSECONDS.items() if whole * 10**places < STAMP_LIMIT_NS), "s")


def _row(words: list[str], unit: str) -> tuple[int, list[float]]:
    """Return the stamp [ns] and the seven numbers of a line. Raises ValueError with what was found."""
    found = repr(" ".join(words[:9])[:_SHOWN])
    if len(words) != 8:
        raise ValueError(f"expected 8 numbers separated by spaces (t x y z qx qy qz qw), found {len(words)}: {found}")
    # Not by float64, whose resolution at Unix times is 238 ns. adjusted() comes first: 1e999999999 has no end.
    places = _TO_NANOSECONDS[unit]
    try:
        stamp = Decimal(words[0])
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or stamp.adjusted() + places > 21 or abs(stamp.scaleb(places)) >= STAMP_LIMIT_NS:
        raise ValueError(f"expected a stamp in seconds, found {words[0][:_SHOWN]!r}")
    try:
        pose = np.array([float(word) for word in words[1:]])
    except ValueError:
        pose = np.array(np.nan)
    if not np.isfinite(pose).all():
        raise ValueError(f"expected finite numbers, found {found}")
    xyz, q = np.split(np.abs(pose), [len(_AXES)])
    if xyz.max() > POSITION_LIMIT_M:
        raise ValueError(f"expected a position within {POSITION_LIMIT_M:g} m, found {found}")
    if q.max() < 1 / POSITION_LIMIT_M:
        raise ValueError(f"expected a unit quaternion, found zero: {found}")
    return int(stamp.scaleb(places).to_integral_value()), pose.tolist()
