"""Trajectories in the TUM format: one pose a line, `t x y z qx qy qz qw` (seconds, metres, unit quaternion)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError

FILE_LIMIT_BYTES = 1 << 28  # about 2.5 million poses, days of driving; a log given by mistake is refused
POSITION_LIMIT_M = 1e9  # Largest coordinate, so that squares and sums cannot overflow.
STAMP_LIMIT_NS = 1 << 62  # Largest stamp, so that the difference of two stamps fits int64.
_DECIMALS = 9  # nanoseconds, nanometres
_COLUMNS = 8  # t x y z qx qy qz qw
_MIN_QUATERNION = 1e-9  # largest component below which a quaternion counts as zero
_SHOWN_CHARACTERS = 60  # Most characters of a wrong value in a message.


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses T_odom_rig (or T_world_rig) over time; stamps increase strictly; both arrays are read-only."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T: NDArray[np.float64]  # (N, 4, 4)


@dataclass(frozen=True, slots=True)
class _Row:
    line: int
    stamp_ns: int
    pose: tuple[float, ...]  # x y z qx qy qz qw, quaternion of any length above zero


def read_tum(path: str | Path) -> Trajectory:
    """Return the trajectory of a TUM file, sorted by stamp.

    Blank lines and everything after `#` are skipped; quaternions are normalised. A repeated stamp is refused: two poses
    at one time contradict each other. Raises OmnidError that names the file, the line and what was found.
    """
    text = _read_text(Path(path))
    rows = sorted(_rows(text, str(path)), key=lambda row: row.stamp_ns)
    if not rows:
        raise OmnidError(f"{path}: no pose found: expected lines 't x y z qx qy qz qw'")
    _refuse_repeated_stamps(rows, str(path))
    return _trajectory(rows)


def tum_row(stamp_ns: int, T: NDArray[np.float64]) -> str:
    """Return a TUM line without newline: 9 decimals, w >= 0, never '-0', so the same bytes for the same pose."""
    sign, (whole_s, rest_ns) = "-" if stamp_ns < 0 else "", divmod(abs(int(stamp_ns)), 10**9)
    pose = np.concatenate([T[:3, 3], _canonical(se3.quaternion(T[:3, :3]))])
    numbers = [f"{float(value):.{_DECIMALS}f}" for value in np.round(pose, _DECIMALS) + 0.0]
    return " ".join([f"{sign}{whole_s}.{rest_ns:09d}", *numbers])


def _canonical(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return q or -q, so that the last component that prints as non-zero (w, else z, y, x) is positive."""
    printed: NDArray[np.float64] = np.round(q, _DECIMALS)
    visible = printed[printed != 0.0]
    return -printed if visible.size and visible[-1] < 0.0 else printed


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(FILE_LIMIT_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        found = error.strerror if isinstance(error, OSError) else error
        raise OmnidError(f"{path}: cannot read the trajectory: {found}") from error
    if len(raw) > FILE_LIMIT_BYTES:
        raise OmnidError(f"{path}: expected at most {FILE_LIMIT_BYTES >> 20} MiB: split the file")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        found = f"found byte 0x{raw[error.start]:02x}, which is not text"
        raise OmnidError(f"{path}, line {line}: expected 't x y z qx qy qz qw', {found}: is it a TUM file?") from error


def _rows(text: str, name: str) -> Iterator[_Row]:
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for line, content in enumerate(lines, start=1):
        words = content.partition("#")[0].split()
        if words:
            try:
                yield _row(words, line)
            except ValueError as error:
                raise OmnidError(f"{name}, line {line}: {error}") from error


def _row(words: list[str], line: int) -> _Row:
    if len(words) != _COLUMNS:
        found = _shortened(" ".join(words[: _COLUMNS + 1]))
        raise ValueError(
            f"expected {_COLUMNS} numbers separated by spaces (t x y z qx qy qz qw), found {len(words)}: {found}"
        )
    pose = tuple(_number(word) for word in words[1:])
    if max(abs(value) for value in pose[:3]) > POSITION_LIMIT_M:
        raise ValueError(f"expected a position within {POSITION_LIMIT_M:g} m, found {_shortened(' '.join(words[1:4]))}")
    if max(abs(value) for value in pose[3:]) < _MIN_QUATERNION:
        raise ValueError(f"expected a unit quaternion, found zero: {_shortened(' '.join(words[4:]))}")
    return _Row(line, _stamp_ns(words[0]), pose)


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise ValueError(f"expected a finite number, found {_shortened(word)}")
    return value


def _stamp_ns(word: str) -> int:
    """Return the ns of a stamp in decimal seconds, without float64, whose resolution at Unix times is 238 ns."""
    try:
        stamp_s = Decimal(word)
    except InvalidOperation:
        stamp_s = Decimal("nan")
    # adjusted() is checked first: int() of 1e999999999 would not end
    if not stamp_s.is_finite() or stamp_s.adjusted() > 12 or abs(stamp_s.scaleb(9)) >= STAMP_LIMIT_NS:
        raise ValueError(f"expected a stamp in seconds, found {_shortened(word)}")
    return int(stamp_s.scaleb(9).to_integral_value())


def _shortened(text: str) -> str:
    return repr(text if len(text) <= _SHOWN_CHARACTERS else text[: _SHOWN_CHARACTERS - 3] + "...")


def _refuse_repeated_stamps(rows: list[_Row], name: str) -> None:
    for first, second in pairwise(rows):
        if first.stamp_ns == second.stamp_ns:
            found = f"found that of line {first.line} again"
            raise OmnidError(f"{name}, line {second.line}: expected each stamp once, {found}: remove one of the two")


def _trajectory(rows: list[_Row]) -> Trajectory:
    stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
    pose = np.array([row.pose for row in rows], dtype=np.float64)
    q = pose[:, 3:] / np.abs(pose[:, 3:]).max(axis=1, keepdims=True)  # scaled so that squares in se3 cannot overflow
    T = se3.transform(se3.rotation(q), pose[:, :3])
    stamps_ns.setflags(write=False)
    T.setflags(write=False)
    return Trajectory(stamps_ns, T)
