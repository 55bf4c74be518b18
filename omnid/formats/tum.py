"""Trajectories in the TUM format: one pose a line, `t x y z qx qy qz qw` (seconds, metres, unit quaternion)."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.logs.log import LATEST_NS, MAX_RECORD_BYTES
from omnid.errors import OmnidError

Array = NDArray[np.float64]
POSITION_LIMIT_M: Final = 1e9  # Largest coordinate, so that squares and sums cannot overflow.
_DECIMALS: Final = 9  # nanoseconds, nanometres


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
    found, line = list[tuple[int, int, list[float]]](), 0
    try:
        with Path(path).open(encoding="utf-8-sig", errors="replace", newline="\n") as file:
            for line, content in enumerate(iter(lambda: file.readline(MAX_RECORD_BYTES), ""), start=1):
                if words := content.partition("#")[0].split():
                    stamp_ns, pose = _row(words)
                    found.append((stamp_ns, line, pose))
    except OSError as error:
        raise OmnidError(f"{path}: cannot read the trajectory: {error.strerror}") from error
    except ValueError as error:  # in line 0: a NUL in the name
        raise OmnidError(f"{path}, line {line}: {error}") from error
    # 2. Sorted by stamp, each once.
    found.sort(key=lambda pose: pose[0])
    if not found:
        raise OmnidError(f"{path}: no pose found: expected lines 't x y z qx qy qz qw'")
    for (before_ns, first, _), (stamp_ns, second, _) in pairwise(found):
        if before_ns == stamp_ns:
            raise OmnidError(f"{path}, line {second}: its stamp is that of line {first}: remove one of the two")
    xyz, q = np.split(np.array([pose for *_, pose in found]), [3], axis=1)
    T = se3.transform(se3.rotation(q), xyz)
    stamps_ns = np.array([stamp_ns for stamp_ns, *_ in found], np.int64)
    stamps_ns.setflags(write=False)
    T.setflags(write=False)
    return Trajectory(stamps_ns, T)


def tum_row(stamp_ns: int, T: Array) -> str:
    """Return a TUM line without newline: 9 decimals, w >= 0, never '-0', so the same bytes for the same pose."""
    sign, (whole_s, rest_ns) = "-" if stamp_ns < 0 else "", divmod(abs(int(stamp_ns)), 10**9)
    R, xyz = parts(T)
    pose = np.round(np.concatenate([xyz, se3.quaternion(R)]), _DECIMALS) + 0.0
    return " ".join([f"{sign}{whole_s}.{rest_ns:09d}", *(f"{float(value):.{_DECIMALS}f}" for value in pose)])


def _row(words: list[str]) -> tuple[int, list[float]]:
    """Return the stamp [ns] and the seven numbers of a line. Raises ValueError with what was found."""
    found = repr(" ".join(words[:9])[:60])
    if len(words) != 8:
        raise ValueError(f"expected 8 numbers separated by spaces (t x y z qx qy qz qw), found {len(words)}: {found}")
    # Not by float64, whose resolution at Unix times is 238 ns. adjusted() comes first: 1e999999999 has no end.
    try:
        stamp, pose = Decimal(words[0]), np.array(words[1:], float)
    except (InvalidOperation, ValueError):
        raise ValueError(f"expected numbers, found {found}") from None
    if not stamp.is_finite() or stamp.adjusted() > 12 or abs(stamp.scaleb(_DECIMALS)) >= LATEST_NS:
        raise ValueError(f"expected a stamp in seconds, found {found}")
    size, norm = np.abs(pose).max(), np.abs(pose[3:]).max()
    # Negated, so that what is not finite is refused as well.
    if not (size <= POSITION_LIMIT_M and norm >= 1 / POSITION_LIMIT_M):
        raise ValueError(f"expected numbers within {POSITION_LIMIT_M:g} m, and a unit quaternion, found {found}")
    return int(stamp.scaleb(_DECIMALS).to_integral_value()), pose.tolist()
