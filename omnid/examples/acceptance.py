"""The acceptance drive: is the robot as accurate on your floor as its rig promises?

1. Tape two marks A and B on the floor, 10 to 20 m apart, and measure their distance with a tape measure.
2. Record: `omnid record drive` (stop the daemon first), or `omnid run` with record.enabled.
3. Stand on A for 5 s, drive to B, stand for 5 s, drive back to A, stand: a round. Drive three, with the same point of
   the robot over each mark, and the same heading as before if you can. Pause nowhere within a fifth of their distance.
4. `python -m omnid.examples.acceptance LOG DISTANCE_M [RIG.toml]`; LOG is the recording, or a trajectory (.txt, TUM).

Exit code 1: a length or the end of a round is off by more than 0.5 % and 10 mm, which placing a robot by eye explains.
Exit code 2: there is nothing to judge, and one line says why.
"""

import math
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.errors import CalibError
from calib.rig_file import read_rig
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum

STAND_M, STAND_RAD, STAND_S = 0.02, np.radians(2.0), 2.0  # at rest: the robot stays within these for this time
PLACING_M, ACCEPTED = 0.01, 0.005  # error of placing a robot by eye; accepted error as a fraction of the way

Array = NDArray[np.float64]


def rests(stamps_s: Array, T: Array) -> list[int]:
    """Return the indices of the middle poses of all rests; T (N, 4, 4): T_odom_base."""
    middles, first, yaw_rad = [], 0, np.unwrap(se3.yaw(T))
    while first < len(T):
        moved = np.linalg.norm((T[first:] - T[first])[:, :, -1], axis=1) > STAND_M
        moved |= np.abs(yaw_rad[first:] - yaw_rad[first]) > STAND_RAD
        end = first + int(moved.argmax()) if moved.any() else len(T)
        if is_stand := stamps_s[end - 1] - stamps_s[first] >= STAND_S:
            middles.append((first + end - 1) // 2)
        first = end if is_stand else first + 1
    return middles


def visits(xyz: Array, rests: list[int], distance_m: float) -> list[int]:
    """Return the poses on A, B, A, ...: the first rest, and those that are about the distance away from the last."""
    found = rests[:1]
    for pose in rests[1:]:
        if math.dist(xyz[pose], xyz[found[-1]]) > 0.8 * distance_m:  # else a pause, or the same mark
            found.append(pose)
    return found


def judge(stamps_s: Array, T: Array, distance_m: float) -> int:
    """Print the errors of each round; return 1 where one is not accepted."""
    xyz = T[:, :-1, -1]
    marks = visits(xyz, rests(stamps_s, T), distance_m)
    if len(marks) < 3:
        found = len(marks)
        raise OmnidError(f"expected rests of {STAND_S:g} s on A, on B {distance_m:g} m away, and on A; found {found}")
    legs_m = np.array([math.dist(xyz[a], xyz[b]) for a, b in pairwise(marks)])
    for leg, length_m in enumerate(legs_m):
        print(f"{'AB'[leg % 2]} to {'BA'[leg % 2]} {length_m:.4f} m, {length_m / distance_m - 1:+.2%}")
    accepted = bool((abs(legs_m - distance_m) <= ACCEPTED * distance_m + PLACING_M).all())
    for start, end in zip(marks[:-2:2], marks[2::2], strict=False):
        way_m = np.linalg.norm(np.diff(xyz[start : end + 1], axis=0), axis=1).sum()
        off_m = math.dist(xyz[end], xyz[start])
        print(f"round of {way_m:.2f} m: ends {1e3 * off_m:.0f} mm from its start, {off_m / way_m:.2%}")
        accepted &= bool(off_m <= ACCEPTED * way_m + PLACING_M)
    print("accepted" if accepted else "not accepted")
    return int(not accepted)


def main(arguments: list[str]) -> int:
    """Judge the log or trajectory that the arguments name."""
    if len(arguments) not in (2, 3):
        raise OmnidError("expected LOG DISTANCE_M [RIG.toml], as the first lines of this file say")
    log, distance, *rig = arguments
    distance_m = float(distance)
    if not 0 < distance_m < math.inf:
        raise OmnidError(f"DISTANCE_M {distance}: expected the distance of the marks, above 0")
    if Path(log).suffix in (".txt", ".tum"):
        path = read_tum(Path(log))
        stamps_ns, T_odom_rig = path.stamps_ns, path.T
    else:
        run = omnid.replay(log, rig=rig[0] if rig else None)
        stamps_ns, T_odom_rig = run.stamps_ns, run.T_odom_rig
    T_rig_base = se3.inverse(read_rig(Path(rig[0])).T_base_rig) if rig else np.eye(4)
    return judge(1e-9 * (stamps_ns - stamps_ns[0]), T_odom_rig @ T_rig_base, distance_m)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except (CalibError, OmnidError, ValueError) as error:  # of files, rigs and numbers: 1 is a result, 2 an error
        print(f"acceptance: {error}", file=sys.stderr)
        sys.exit(2)
