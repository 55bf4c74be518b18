"""Trajectories in the TUM format: one pose a line, `t x y z qx qy qz qw` (seconds, metres, unit quaternion).

A head that names the columns, as `#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...` of EuRoC's CSV files, tells the
order of the quaternion and the unit of the stamps.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from io import BytesIO, TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError

FILE_LIMIT_BYTES = 1 << 28  # about 2.5 million poses, days of driving; a log given by mistake is refused
POSITION_LIMIT_M = 1e9  # Largest coordinate, so that squares and sums cannot overflow.
STAMP_LIMIT_NS = 1 << 62  # Largest stamp, so that the difference of two stamps fits int64.
_DECIMALS = 9  # nanoseconds, nanometres
# Decimal places by which the point of a stamp moves to nanoseconds, by its unit. Where the file does not name it, it is
# the first unit that gives a time within the limit.
_TO_NANOSECONDS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
_MIN_QUATERNION = 1e-9  # largest component below which a quaternion counts as zero


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses T_odom_rig (or T_world_rig) over time; stamps increase strictly; both arrays are read-only."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T: NDArray[np.float64]  # (N, 4, 4)


def read_tum(path: str | Path) -> Trajectory:
    """Return the trajectory of a TUM file, sorted by stamp.

    Blank lines and everything after `#` are skipped; quaternions are normalised. A repeated stamp is refused: two poses
    at one time contradict each other. Raises OmnidError that names the file, the line and what was found.
    """
    # 1. Stamps and numbers of each line.
    raw, stamps, poses, lines, line = _read(Path(path)), list[int](), list[list[float]](), list[int](), 0
    layout = _Layout()
    try:
        for line, content in enumerate(TextIOWrapper(BytesIO(raw), "utf-8-sig"), start=1):
            data, _, comment = content.partition("#")
            words = data.replace(",", " ").split()
            if words and (lines or not _is_head(words)):
                layout = layout if lines else layout.of_first_stamp(words[0])
                stamp_ns, pose = _row(words[:8] if "," in data else words, layout)
                stamps.append(stamp_ns)
                poses.append(pose)
                lines.append(line)
            elif not lines:
                layout = layout.of_head(data if words else comment)
    except UnicodeDecodeError:
        raise OmnidError(f"{path}: expected 't x y z qx qy qz qw' in each line, found bytes that are no text") from None
    except ValueError as error:
        raise OmnidError(f"{path}, line {line}: {error}") from error
    if not lines:
        raise OmnidError(f"{path}: no pose found: expected lines 't x y z qx qy qz qw'")
    # 2. Sorted by stamp, each once.
    order = np.argsort(stamps, kind="stable")
    stamps_ns, pose_of = np.array(stamps, np.int64)[order], np.array(poses)[order]
    for n in np.flatnonzero(np.diff(stamps_ns) == 0).tolist():
        first, second = lines[order[n]], lines[order[n + 1]]
        raise OmnidError(
            f"{path}, line {second}: expected each stamp once, found that of line {first} again: remove one of the two"
        )
    q = pose_of[:, 3:] / np.abs(pose_of[:, 3:]).max(axis=1, keepdims=True)  # so that squares in se3 cannot overflow
    T = se3.transform(se3.rotation(q), pose_of[:, :3])
    stamps_ns.setflags(write=False)
    T.setflags(write=False)
    return Trajectory(stamps_ns, T)


def tum_row(stamp_ns: int, T: NDArray[np.float64]) -> str:
    """Return a TUM line without newline: 9 decimals, w >= 0, never '-0', so the same bytes for the same pose."""
    sign, (whole_s, rest_ns) = "-" if stamp_ns < 0 else "", divmod(abs(int(stamp_ns)), 10**9)
    q = se3.quaternion(T[:3, :3])
    # The last component that prints as non-zero (w, else z, y, x) is positive.
    visible = np.round(q, _DECIMALS)[np.round(q, _DECIMALS) != 0.0]
    pose = np.round(np.concatenate([T[:3, 3], -q if visible.size and visible[-1] < 0.0 else q]), _DECIMALS) + 0.0
    return " ".join([f"{sign}{whole_s}.{rest_ns:09d}", *(f"{float(value):.{_DECIMALS}f}" for value in pose)])


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            raw = file.read(FILE_LIMIT_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the trajectory: {getattr(error, 'strerror', None) or error}") from error
    if len(raw) > FILE_LIMIT_BYTES:
        raise OmnidError(f"{path}: expected at most {FILE_LIMIT_BYTES >> 20} MiB: split the file")
    return raw


@dataclass(frozen=True, slots=True)
class _Layout:
    """What the head of a file tells about its columns."""

    quaternion: tuple[int, int, int, int] = (0, 1, 2, 3)  # places of x, y, z, w among the last four columns
    unit: str = ""  # of the stamps, a key of _TO_NANOSECONDS

    def of_head(self, text: str) -> _Layout:
        """Return the layout by the names of the columns, as far as these are time, x, y, z and a quaternion."""
        unit = re.match(r"[^,]*\[(s|ms|us|ns)\]", text)
        names = re.sub(r"\[[^\]]*\]", "", text).replace(",", " ").lower().split()
        axes = [name[-1] for name in names[1:8]]
        if axes[:3] != ["x", "y", "z"] or sorted(axes[3:]) != ["w", "x", "y", "z"]:
            return self
        x, y, z, w = (axes[3:].index(axis) for axis in "xyzw")
        return _Layout((x, y, z, w), unit[1] if unit else "")

    def of_first_stamp(self, word: str) -> _Layout:
        """Return the layout with the unit of the stamps, if the head does not name it: by the first one's size."""
        if self.unit or not re.fullmatch(r"\d{10,19}", word):
            return self
        fitting = [unit for unit, places in _TO_NANOSECONDS.items() if int(word) * 10**places < STAMP_LIMIT_NS]
        return _Layout(self.quaternion, fitting[0] if fitting else "")


def _is_head(words: list[str]) -> bool:
    """True for words of which none is a number: names of columns."""
    return all(re.match(r"[-+.]?[0-9]", word) is None for word in words) and len(words) > 1


def _row(words: list[str], layout: _Layout) -> tuple[int, list[float]]:
    """Return the stamp [ns] and x y z qx qy qz qw of a line. Raises ValueError with what was found."""
    found = repr(" ".join(words[:9])[:60])
    if len(words) != 8:
        raise ValueError(f"expected 8 numbers separated by spaces (t x y z qx qy qz qw), found {len(words)}: {found}")
    # Not by float64, whose resolution at Unix times is 238 ns. adjusted() comes first: 1e999999999 has no end.
    places = _TO_NANOSECONDS[layout.unit or "s"]
    try:
        stamp = Decimal(words[0])
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or stamp.adjusted() > 21 - places or abs(stamp.scaleb(places)) >= STAMP_LIMIT_NS:
        raise ValueError(f"expected a stamp in seconds, found {words[0][:60]!r}")
    try:
        pose = [float(word) for word in words[1:]]
    except ValueError:
        pose = [float("nan")]
    if not np.isfinite(pose).all():
        raise ValueError(f"expected finite numbers, found {found}")
    if max(map(abs, pose[:3])) > POSITION_LIMIT_M:
        raise ValueError(f"expected a position within {POSITION_LIMIT_M:g} m, found {found}")
    if max(map(abs, pose[3:])) < _MIN_QUATERNION:
        raise ValueError(f"expected a unit quaternion, found zero: {found}")
    return int(stamp.scaleb(places).to_integral_value()), [*pose[:3], *(pose[3 + place] for place in layout.quaternion)]
