"""What one constant difference between an estimate and its truth explains: another body, another clock.

A truth is often the trajectory of another body on the same robot: a marker, an IMU, a camera. With a constant pose
T_rig_body of that body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body(t + delay) = T_truth_odom T_odom_rig(t) T_rig_body.

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
from itertools import product
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
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

    delay_s: float = 0.0  # of the truth's stamps against the estimate's
    T_rig_body: Array | None = None  # (4, 4); None: the rig itself
    freedom: int = 0  # number of fitted unknowns that the path determines
    unknown: str = ""  # axes of the lever arm that the path does not show

    def rig_poses(self, truth: Trajectory, estimate: Trajectory) -> Trajectory:
        """Return the truth of the rig on the estimate's clock; after a delay at the estimate's stamps."""
        T = truth.T if self.T_rig_body is None else truth.T @ se3.inverse(self.T_rig_body)
        of_rig = Trajectory(truth.stamps_ns - round(self.delay_s * 1e9), T)
        covered = _covered(estimate, of_rig).stamps_ns
        return Trajectory(covered, _at(of_rig, covered)) if self.delay_s else of_rig

    def __str__(self) -> str:
        """Return the differences in one line."""
        words = []
        if self.delay_s:
            words.append(f"its stamps are {abs(self.delay_s):.3f} s {'later' if self.delay_s > 0 else 'earlier'}")
        if self.T_rig_body is not None:
            words.append("it is of another body than the rig")
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
    # 1. Fit a delay, a turn and a lever arm, or none of these.
    found: list[tuple[int, float, tuple[bool, ...], TruthFrame]] = []
    for fitted in product((False, True), repeat=3):
        frame = _fitted(estimate, truth, *fitted)
        if frame is not None:
            found.append((sum(fitted), _error(estimate, frame.rig_poses(truth, estimate)), fitted, frame))
    # 2. Of those that leave little, the one with the fewest differences.
    most = max(LEAST_SIGMA, min((left for _, left, *_ in found), default=math.inf)) / WORTH_PART
    good = [one for one in found if one[1] <= most < math.inf]
    if not good:
        return None
    changes, _, fitted, frame = min(good, key=lambda one: one[:2])
    if not changes:
        return None
    # 3. It must explain the error of each half of the drive by the other half; an error of the spread is the most.
    middle = len(estimate.stamps_ns) // 2
    halves = [Trajectory(estimate.stamps_ns[part], estimate.T[part]) for part in np.s_[:middle, middle:]]
    left = plain = 0.0
    for one, other in (halves, halves[::-1]):
        of_half = _fitted(one, truth, *fitted)
        left += math.inf if of_half is None else _error(other, of_half.rig_poses(truth, other))
        plain += min(1.0, _error(other, truth))
    return frame if left < WORTH_PART * plain else None


def _fitted(
    estimate: Trajectory, truth: Trajectory, has_delay: bool, is_turned: bool, has_lever: bool
) -> TruthFrame | None:
    """Return a difference, of which what is not wanted is none; None where too few poses are at the same times."""

    def left(delay_s: float) -> float:
        pair = _common(estimate, truth, delay_s)
        return math.inf if pair is None else _body(*pair, is_turned, has_lever)[2]

    # 1. The delay by which the pose of the body leaves the least error.
    delay_s, step_s = _delay(estimate, truth) if has_delay else (0.0, 0.0)
    if has_delay:
        bounds, options = (delay_s - step_s, delay_s + step_s), {"xatol": 1e-4}
        delay_s = float(minimize_scalar(left, bounds=bounds, method="bounded", options=options).x)
    # 2. The pose of the body.
    pair = _common(estimate, truth, delay_s)
    if pair is None:
        return None
    T_rig_body, unknown, _ = _body(*pair, is_turned, has_lever)
    freedom = has_delay + 3 * is_turned + (3 - len(unknown)) * has_lever
    body = T_rig_body if has_lever or is_turned else None
    return TruthFrame(delay_s, body, freedom, ", ".join(unknown))


def _body(T_odom_rig: Array, T_truth_body: Array, is_turned: bool, has_lever: bool) -> tuple[Array, str, float]:
    """Return T_rig_body (4, 4) by poses (N, 4, 4) of the same times, and what these do not show and explain.

    These are the axes along which the path shows no lever arm, and the errors of position [m] times rotation [rad].
    """
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
    return se3.transform(R_rig_body, lever), unknown, _rms(moved - swing @ lever) * _rms(error)


def _error(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the error that `omnid eval` shows, see `_shown_error`; infinite without poses at the same times."""
    pair = _common(estimate, truth, 0.0)
    return math.inf if pair is None else _shown_error(*pair, np.eye(4))


def _shown_error(T_odom_rig: Array, T_truth_body: Array, T_rig_body: Array) -> float:
    """Return the error of poses (N, 4, 4) of which the first ones agree.

    It is that of the positions as a fraction of the larger of both spreads, plus that of the rotations [rad].
    """
    T_true = T_truth_body @ se3.inverse(T_rig_body)
    R, xyz = parts(se3.inverse(T_true) @ T_true[0] @ se3.inverse(T_odom_rig[0]) @ T_odom_rig)
    return _rms(xyz) / max(_spread(T_true), _spread(T_odom_rig), LEAST_SIGMA) + _rms(se3.rotation_log(R))


def _covered(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the part of an estimate that a truth covers."""
    covered = (estimate.stamps_ns >= truth.stamps_ns[0]) & (estimate.stamps_ns <= truth.stamps_ns[-1])
    return Trajectory(estimate.stamps_ns[covered], estimate.T[covered])


def _common(estimate: Trajectory, truth: Trajectory, delay_s: float) -> tuple[Array, Array] | None:
    """Return the estimate's poses that the truth covers, evenly chosen, and the truth interpolated there.

    None where these are fewer than unknowns: three poses have 18 numbers.
    """
    if len(truth.stamps_ns) <= 3:
        return None
    late = Trajectory(truth.stamps_ns - round(delay_s * 1e9), truth.T)
    covered = _covered(estimate, late)
    if len(covered.stamps_ns) <= 3:
        return None
    chosen = np.unique(np.linspace(0, len(covered.stamps_ns) - 1, MAX_POSES).astype(int))
    return covered.T[chosen], _at(late, covered.stamps_ns[chosen])


def _at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Array:
    """Return the poses (N, 4, 4) of a trajectory at times within it."""
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right"), 1, len(trajectory.T) - 1)
    before, T = trajectory.stamps_ns[after - 1], trajectory.T[after - 1]
    part = (stamps_ns - before) / (trajectory.stamps_ns[after] - before)
    return np.asarray(T @ se3.exp(se3.log(se3.inverse(T) @ trajectory.T[after]) * part[:, None]))


def _delay(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return how late the truth's stamps are [s], and how precisely: by the correlation of speeds and rates of turning.

    Both are the same for every body fixed to the robot, but for the lever arm's part of the speed. The shorter one
    may exceed the longer one by half of its length at both ends.
    """
    # 1. Rates at times that are a step apart, as dense as the sparser trajectory.
    step_ns = max(int(np.ptp(one.stamps_ns)) // (len(one.T) - 1) for one in (estimate, truth))
    ours, theirs = _rates(estimate, step_ns), _rates(truth, step_ns)
    shorter, longer = sorted((ours, theirs), key=len)
    # 2. Normalised correlation at each shift.
    half = len(shorter) // 2
    score = 0.0
    for a, b in zip(longer.T, shorter.T, strict=True):
        if a.std() and b.std():
            padded = np.pad(a, half, mode="mean").astype(np.float32)
            score = score + cv2.matchTemplate(padded[None], b.astype(np.float32)[None], cv2.TM_CCOEFF_NORMED)[0]
    shift_ns = (int(np.argmax(score)) - half) * step_ns if np.any(score) else 0
    begins_apart_ns = int(truth.stamps_ns[0] - estimate.stamps_ns[0])
    return 1e-9 * (begins_apart_ns + (shift_ns if longer is theirs else -shift_ns)), 1e-9 * step_ns


def _rates(trajectory: Trajectory, step_ns: int) -> Array:
    """Return the rate of turning [rad/s] and the speed [m/s] (N, 2) at times a step apart."""
    T = _at(trajectory, np.arange(trajectory.stamps_ns[0], trajectory.stamps_ns[-1] + 1, step_ns))
    translation, rotation = np.split(se3.log(se3.inverse(T[:-1]) @ T[1:]), 2, axis=1)
    rates = [np.linalg.norm(part, axis=1) / (1e-9 * step_ns) for part in (rotation, translation)]
    return np.round(np.column_stack(rates), 6)  # so that rounding is no rate


def _spread(T: Array) -> float:
    """Return how far the positions of poses (N, 4, 4) are from their mean."""
    _, xyz = parts(T)
    return _rms(xyz - xyz.mean(axis=0))


def _rms(vectors: Array) -> float:
    """Return the root of the mean squared length of vectors (N, 3)."""
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))
