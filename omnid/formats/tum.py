"""Trajectories in the TUM format: one pose a line, `t x y z qx qy qz qw` (seconds, metres, unit quaternion).

A head that names the columns, as `#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...` of EuRoC's CSV files, states the
order of the quaternion. A whole number of 16 digits or more is a stamp in nanoseconds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
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
    found, line, order = list[tuple[int, int, list[float]]](), 0, _QUATERNION
    try:
        for line, content in enumerate(_lines(Path(path)), start=1):
            data, _, comment = content.partition("#")
            words = data.replace(",", " ").split()
            is_head = len(words) > 1 and not any(re.match(r"[-+.]?[0-9]", word) for word in words)
            if words and (found or not is_head):
                # Tables may have more columns, such as velocities.
                stamp_ns, pose = _row(words[:8] if "," in data else words)
                found.append((stamp_ns, line, pose))
            elif not found:
                order = _quaternion_order(data if words else comment) or order
    except ValueError as error:
        raise OmnidError(f"{path}, line {line}: {error}") from error
    # 2. Sorted by stamp, each once.
    found.sort(key=lambda pose: pose[0])
    if not found:
        raise OmnidError(f"{path}: no pose found: expected lines 't x y z qx qy qz qw'")
    for (before_ns, first, _), (stamp_ns, second, _) in pairwise(found):
        if before_ns == stamp_ns:
            raise OmnidError(f"{path}, line {second}: its stamp is that of line {first}: remove one of the two")
    xyz, q = np.split(np.array([pose for *_, pose in found]), [len(_AXES)], axis=1)
    T = se3.transform(se3.rotation(q[:, [order.index(name) for name in _QUATERNION]]), xyz)
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


def _lines(path: Path) -> list[str]:
    """Return the lines of a text; comments may have any encoding."""
    try:
        with path.open("rb") as file:
            raw = file.read(FILE_LIMIT_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the trajectory: {getattr(error, 'strerror', None) or error}") from error
    if len(raw) > FILE_LIMIT_BYTES:
        raise OmnidError(f"{path}: expected at most {FILE_LIMIT_BYTES >> 20} MiB: split the file")
    return raw.decode("utf-8-sig", "replace").split("\n")


def _quaternion_order(head: str) -> list[str] | None:
    """Return the order of the quaternion; None unless a head names time, position, quaternion."""
    names = re.sub(r"\[[^\]]*\]", "", head).lower().replace(",", " ").split()
    axes = [name[-1] for name in names[1:8]]
    order = axes[len(_AXES) :]
    return order if axes[: len(_AXES)] == _AXES and sorted(order) == sorted(_QUATERNION) else None


def _row(words: list[str]) -> tuple[int, list[float]]:
    """Return the stamp [ns] and the seven numbers of a line. Raises ValueError with what was found."""
    found = repr(" ".join(words[:9])[:_SHOWN])
    if len(words) != 8:
        raise ValueError(f"expected 8 numbers separated by spaces (t x y z qx qy qz qw), found {len(words)}: {found}")
    # Not by float64, whose resolution at Unix times is 238 ns. adjusted() comes first: 1e999999999 has no end.
    places = 0 if re.fullmatch(r"\d{16,19}", words[0]) else _DECIMALS
    try:
        stamp, pose = Decimal(words[0]), np.array(words[1:], float)
    except (InvalidOperation, ValueError):
        raise ValueError(f"expected numbers, found {found}") from None
    if not stamp.is_finite() or stamp.adjusted() + places > 21 or abs(stamp.scaleb(places)) >= STAMP_LIMIT_NS:
        raise ValueError(f"expected a stamp in seconds, found {words[0][:_SHOWN]!r}")
    size, norm = np.abs(pose).max(), np.abs(pose[len(_AXES) :]).max()
    # Negated, so that what is not finite is refused as well.
    if not (size <= POSITION_LIMIT_M and norm >= 1 / POSITION_LIMIT_M):
        raise ValueError(f"expected numbers within {POSITION_LIMIT_M:g} m, and a unit quaternion, found {found}")
    return int(stamp.scaleb(places).to_integral_value()), pose.tolist()
