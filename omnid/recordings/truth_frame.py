"""What one constant difference between an estimate and its truth explains: another body.

A truth is often the trajectory of another body on the same robot: a marker, an IMU, a camera. With a constant pose
T_rig_body of that body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body = T_truth_odom T_odom_rig T_rig_body.

With A = R_truth_odom^T this is linear in A, R_rig_body and both translations (robot-world and hand-eye calibration,
Shah 2013, with the positions in the same system):

    A R_truth_body = R_odom_rig R_rig_body,    A p_truth_body = R_odom_rig t_rig_body + p_odom_rig + c.

Rotations are the nearest ones to the solution. Of the differences that leave about the least error, the one with the
fewest parts is reported, if what each half of the drive shows of it explains the error of the other half: drift, jumps
and other drives show none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib import se3
from omnid.formats.tum import Trajectory, parts
from omnid.recordings.evaluation import rotation_between

Array = NDArray[np.float64]
# Of two explanations the simpler one is reported, unless the other leaves less than this part of its error.
WORTH_PART: Final = 0.5
SMALL_ERROR: Final = 0.02  # as a fraction of the path's spread, and rad: that of odometry needs no explanation
MAX_POSES: Final = 100  # Poses of a fit, evenly spread, for the 13 unknowns.
LEAST_SIGMA: Final = 1e-6  # [m, rad] Residuals of exact poses count as this.


@dataclass(frozen=True, slots=True)
class TruthFrame:
    """How a truth differs from the truth of an estimate's own rig, and what of it was fitted."""

    T_rig_body: Array  # (4, 4)
    freedom: int  # number of fitted unknowns that the path determines
    unknown: str  # axes of the lever arm that the path does not show

    def rig_poses(self, truth: Trajectory) -> Trajectory:
        """Return the truth of the rig."""
        return Trajectory(truth.stamps_ns, truth.T @ se3.inverse(self.T_rig_body))

    def __str__(self) -> str:
        """Return the differences in one line."""
        words = ["it is of another body than the rig"]
        R, (x, y, z) = parts(self.T_rig_body)
        if not np.array_equal(R, np.eye(len(R))):
            words.append(f"turned by {_turn_words(R)}")
        if np.any([x, y, z]):
            unknown = f" (the path does not show {self.unknown})" if self.unknown else ""
            words.append(f"at x {x:.3f} y {y:.3f} z {z:.3f} m{unknown}")
        return ", ".join(words)


def _turn_words(R: Array) -> str:
    """Return a rotation in degrees and its axis: x, y or z where it is within two degrees of one."""
    w = se3.rotation_log(R)
    angle_deg = math.degrees(np.linalg.norm(w))
    axis = w / np.linalg.norm(w)
    main = int(np.abs(axis).argmax())
    if abs(axis[main]) > math.cos(math.radians(2)):
        return f"{math.copysign(angle_deg, axis[main]):.1f} deg about {'xyz'[main]}"
    return f"{angle_deg:.1f} deg about ({' '.join(f'{part:.2f}' for part in axis)})"


def find_truth_frame(estimate: Trajectory, truth: Trajectory) -> TruthFrame | None:
    """Return the simplest difference that explains the error of an estimate; None where none is needed.

    A difference explains an error if no other leaves less than half of it, and if half of the drive shows the
    difference that halves the error of the other half: drift shows none. The rigid transform between the two worlds is
    no difference.
    """
    if _error(estimate, truth) < SMALL_ERROR:
        return None
    # 1. Fit a turn, a lever arm or both.
    found: list[tuple[int, float, tuple[bool, bool], TruthFrame]] = []
    for fitted in ((True, False), (False, True), (True, True)):
        frame = _fitted(estimate, truth, *fitted)
        if frame is not None:
            found.append((sum(fitted), _error(estimate, frame.rig_poses(truth)), fitted, frame))
    # 2. Of those that leave little, the one with the fewest differences.
    plain = _error(estimate, truth)
    most = max(LEAST_SIGMA, min((left for _, left, *_ in found), default=math.inf)) / WORTH_PART
    good = [one for one in found if one[1] <= most]
    if not good or plain <= most:
        return None
    _, _, fitted, frame = min(good, key=lambda one: one[:2])
    # 3. It must explain the error of each half of the drive by the other half; an error of the spread is the most.
    middle = len(estimate.stamps_ns) // 2
    halves = [Trajectory(estimate.stamps_ns[part], estimate.T[part]) for part in np.s_[:middle, middle:]]
    left = plain = 0.0
    for one, other in (halves, halves[::-1]):
        of_half = _fitted(one, truth, *fitted)
        left += math.inf if of_half is None else _error(other, of_half.rig_poses(truth))
        plain += min(1.0, _error(other, truth))
    return frame if left < WORTH_PART * plain else None


def _fitted(estimate: Trajectory, truth: Trajectory, is_turned: bool, has_lever: bool) -> TruthFrame | None:
    """Return a difference, of which what is not wanted is none; None where too few poses are at the same times."""
    pair = _common(estimate, truth)
    if pair is None:
        return None
    T_rig_body, unknown = _body(*pair, is_turned, has_lever)
    return TruthFrame(T_rig_body, 3 * is_turned + (3 - len(unknown)) * has_lever, ", ".join(unknown))


def _body(T_odom_rig: Array, T_truth_body: Array, is_turned: bool, has_lever: bool) -> tuple[Array, str]:
    """Return T_rig_body (4, 4) by poses (N, 4, 4) of the same times, and the axes of the lever arm that these hide."""
    (R, p), (true_R, true_p) = parts(T_odom_rig), parts(T_truth_body)
    p, true_p, swing, eye = p - p.mean(axis=0), true_p - true_p.mean(axis=0), R - R.mean(axis=0), np.eye(3)
    # 1. The linear system of A row by row, R_rig_body column by column and t_rig_body. A rotation counts as the
    # movement of a point at the distance of the path's spread, then by the errors that are left.
    radius = max(_rms(true_p), LEAST_SIGMA)
    J, b = np.zeros((4, 3 * len(R), 21)), np.zeros((4, 3 * len(R)))
    for row, vector in enumerate((true_p, *np.moveaxis(true_R, 2, 0))):
        J[row, :, :9] = np.einsum("ab,nc->nabc", eye, vector).reshape(-1, 9)
    for axis in range(3):
        J[1 + axis, :, 9 + 3 * axis : 12 + 3 * axis] = -R.reshape(-1, 3)
        b[1 + axis] = 0.0 if is_turned else R[:, :, axis].ravel()
    J[0, :, 18:], b[0] = -swing.reshape(-1, 3), p.ravel()
    J = J[..., np.repeat([True, is_turned, has_lever], (9, 9, 3))]
    normal, side = np.swapaxes(J, 1, 2) @ J, np.einsum("krc,kr->kc", J, b)
    for _ in range(2):
        weights = np.array([1.0, radius, radius, radius]) ** 2
        solution = np.linalg.pinv(np.tensordot(weights, normal, 1), hermitian=True) @ (weights @ side)
        sigmas = np.sqrt(np.square(J @ solution - b).mean(axis=1))
        radius = sigmas[0] / max(sigmas[1:].mean(), LEAST_SIGMA)
    A, _ = rotation_between(eye, solution[:9].reshape(3, 3).T)
    # 2. The mean of what turns the body's frame into the rig's.
    turned = np.swapaxes(R, 1, 2) @ (A @ true_R)
    R_rig_body = Rotation.from_matrix(turned).mean().as_matrix() if is_turned else eye
    # 3. The lever arm, along axes whose swing exceeds what the errors of the rotations make of it.
    lever, unknown, error, moved = np.zeros(3), "", se3.rotation_log(turned @ R_rig_body.T), true_p @ A.T - p
    if has_lever:
        shown = np.square(swing).mean(axis=0).sum(axis=0) > np.square(error).mean(axis=0).sum() / WORTH_PART
        unknown = "".join(axis for axis, is_shown in zip("xyz", shown, strict=True) if not is_shown)
        lever[shown] = np.linalg.lstsq(swing[:, :, shown].reshape(moved.size, -1), moved.ravel(), rcond=None)[0]
    return se3.transform(R_rig_body, lever), unknown


def _error(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the error that `omnid eval` shows, see `_shown_error`; infinite without poses at the same times."""
    pair = _common(estimate, truth)
    return math.inf if pair is None else _shown_error(*pair, np.eye(4))


def _shown_error(T_odom_rig: Array, T_truth_body: Array, T_rig_body: Array) -> float:
    """Return the error of poses (N, 4, 4) of which the first ones agree.

    It is that of the positions as a fraction of the larger of both spreads, plus that of the rotations [rad].
    """
    T_true = T_truth_body @ se3.inverse(T_rig_body)
    R, xyz = parts(se3.inverse(T_true) @ T_true[0] @ se3.inverse(T_odom_rig[0]) @ T_odom_rig)
    return _rms(xyz) / max(_spread(T_true), _spread(T_odom_rig), LEAST_SIGMA) + _rms(se3.rotation_log(R))


def _common(estimate: Trajectory, truth: Trajectory) -> tuple[Array, Array] | None:
    """Return the estimate's poses that the truth covers, evenly chosen, and the truth interpolated there.

    None where these are fewer than unknowns: three poses have 18 numbers.
    """
    if len(truth.stamps_ns) <= 3:
        return None
    covered = (estimate.stamps_ns >= truth.stamps_ns[0]) & (estimate.stamps_ns <= truth.stamps_ns[-1])
    rows = np.flatnonzero(covered)
    if len(rows) <= 3:
        return None
    chosen = rows[np.unique(np.linspace(0, len(rows) - 1, MAX_POSES).astype(int))]
    return estimate.T[chosen], _at(truth, estimate.stamps_ns[chosen])


def _at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Array:
    """Return the poses (N, 4, 4) of a trajectory at times within it."""
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right"), 1, len(trajectory.T) - 1)
    before, T = trajectory.stamps_ns[after - 1], trajectory.T[after - 1]
    part = (stamps_ns - before) / (trajectory.stamps_ns[after] - before)
    return np.asarray(T @ se3.exp(se3.log(se3.inverse(T) @ trajectory.T[after]) * part[:, None]))


def _spread(T: Array) -> float:
    """Return how far the positions of poses (N, 4, 4) are from their mean."""
    _, xyz = parts(T)
    return _rms(xyz - xyz.mean(axis=0))


def _rms(vectors: Array) -> float:
    """Return the root of the mean squared length of vectors (N, 3)."""
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))
