"""What one constant difference between an estimate and its truth explains: body frame, unit, clock, convention.

A truth is often the trajectory of another body on the same robot: a marker, an IMU, a camera. With a constant pose
T_rig_body of that body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body(t + delay) = T_truth_odom T_odom_rig(t) T_rig_body.

With A = R_truth_odom^T this is linear in A, R_rig_body and both translations (robot-world and hand-eye calibration,
Shah 2013, with the positions in the same system):

    A R_truth_body = R_odom_rig R_rig_body,    A p_truth_body = R_odom_rig t_rig_body + p_odom_rig + c.

Rotations are the nearest ones to the solution. The same is done for other conventions in which the file may be written.
The simplest difference that explains the error is reported, if what each half of the drive shows of it explains the
error of the other half: drift, jumps and other drives show none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

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
# Units of positions, as the number of them in a metre.
UNITS: Final = {"m": 1.0, "mm": 1e3, "cm": 1e2, "km": 1e-3, "feet": 1 / 0.3048, "inches": 1 / 0.0254}
MAX_POSES: Final = 100  # Poses of a fit, evenly spread, for the 13 unknowns.
IDENTITY: Final = np.eye(4)
LEAST_SIGMA: Final = 1e-6  # [m, rad] Residuals of exact poses count as this.


def _with_w_first(T: Array) -> Array:
    """Return poses whose quaternions were read as x y z w, and are w x y z."""
    R, xyz = parts(T)
    return se3.transform(se3.rotation(np.roll(se3.quaternion(R), -1, axis=1)), xyz)


def _with_inverse_rotations(T: Array) -> Array:
    R, xyz = parts(T)
    return se3.transform(np.swapaxes(R, 1, 2), xyz)


def _mirrored(T: Array) -> Array:
    """Return poses of a left-handed world and body, as of game engines, whose y axes point the other way."""
    R, xyz = parts(T)
    signs = np.array([1.0, -1.0, 1.0])
    return se3.transform(signs[:, None] * R * signs, signs * xyz)


# How a file may be written, in words, and the poses T_world_body of the poses as they were read.
READINGS: Final[dict[str, Callable[[Array], Array]]] = {
    "": lambda T: T,
    "its quaternions begin with w": _with_w_first,
    "its poses are inverse (T_body_world)": se3.inverse,
    "its rotations are inverse (conjugated quaternions)": _with_inverse_rotations,
    "its frames are left-handed (y is mirrored)": _mirrored,
    "its quaternions begin with w, its poses are inverse (T_body_world)": lambda T: se3.inverse(_with_w_first(T)),
}


@dataclass(frozen=True, slots=True)
class TruthFrame:
    """How a truth differs from the truth of an estimate's own rig, and what of it was fitted."""

    reading: str = ""  # a key of READINGS
    unit: str = "m"  # a key of UNITS
    delay_s: float = 0.0  # of the truth's stamps against the estimate's
    T_rig_body: Array | None = None  # (4, 4); None: the rig itself
    freedom: int = 0  # number of fitted unknowns that the path determines
    unknown: str = ""  # axes of the lever arm that the path does not show

    def rig_poses(self, truth: Trajectory, estimate: Trajectory) -> Trajectory:
        """Return the truth of the rig, in metres, on the estimate's clock; after a delay at the estimate's stamps."""
        of_body = _late(_in_metres(truth, self.reading, self.unit), self.delay_s)
        T = of_body.T if self.T_rig_body is None else of_body.T @ se3.inverse(self.T_rig_body)
        of_rig = Trajectory(of_body.stamps_ns, T)
        covered = _covered(estimate, of_rig).stamps_ns
        return Trajectory(covered, _at(of_rig, covered)[0]) if self.delay_s else of_rig

    def __str__(self) -> str:
        """Return the differences in one line."""
        words = [self.reading] if self.reading else []
        if self.unit != "m":
            words.append(f"its positions are in {self.unit}")
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


class _Model(NamedTuple):
    """What may differ: the convention of the file, its clock, and the pose of the body."""

    reading: str  # a key of READINGS
    has_delay: bool
    has_lever: bool
    is_turned: bool

    def fit(self, estimate: Trajectory, truth: Trajectory) -> tuple[float, TruthFrame]:
        """Return the error that is left, see `_shown_error`, and the difference; infinite where nothing is fitted."""
        read = _in_metres(truth, self.reading, "m")
        delay_s, step_s = _delay(estimate, read) if self.has_delay else (0.0, 0.0)
        pair = _common(estimate, read, delay_s)
        if pair is None:
            return np.inf, TruthFrame()
        unit = _unit(pair)
        scaled = _in_metres(truth, self.reading, unit)

        def left(more_s: float) -> float:
            pair = _common(estimate, scaled, delay_s + more_s)
            return np.inf if pair is None else self._body(pair)[2]

        if self.has_delay:
            delay_s += float(
                minimize_scalar(left, bounds=(-step_s, step_s), method="bounded", options={"xatol": 1e-4}).x
            )
        pair = _common(estimate, scaled, delay_s)
        if pair is None:
            return np.inf, TruthFrame()
        T_rig_body, unknown, _ = self._body(pair)
        freedom = self.has_delay + 3 * self.is_turned + (3 - len(unknown)) * self.has_lever
        found = T_rig_body if self.has_lever or self.is_turned else None
        return _shown_error(pair, T_rig_body), TruthFrame(
            self.reading, unit, delay_s, found, freedom, ", ".join(unknown)
        )

    def _body(self, pair: _Pair) -> tuple[Array, str, float]:
        """Return T_rig_body (4, 4), the axes along which the path does not show its lever arm, and sigma_p sigma_R."""
        (R, p), (true_R, true_p) = parts(pair.T_odom_rig), parts(pair.T_truth_body)
        p, true_p, count, eye = p - p.mean(axis=0), true_p - true_p.mean(axis=0), len(R), np.eye(3)
        # 1. The linear system of A row by row, c, R_rig_body column by column and t_rig_body. A rotation counts as the
        # movement of a point at the distance of the path's spread, then by the errors that are left.
        of_A = [np.einsum("ab,nc->nabc", eye, vector).reshape(-1, 9) for vector in (true_p, *np.moveaxis(true_R, 2, 0))]
        J = np.zeros((4, 3 * count, 24))
        J[..., :9], J[0, :, 9:12], J[0, :, 21:] = of_A, np.tile(-eye, (count, 1)), -R.reshape(-1, 3)
        J[1:, :, 12:21] = [np.kron(axis, -R.reshape(-1, 3)) for axis in eye]
        b = np.concatenate([p[None], np.moveaxis(R, 2, 0)]).reshape(4, -1) * [[1.0], *[[not self.is_turned]] * 3]
        J = J[..., np.repeat([True, True, self.is_turned, self.has_lever], (9, 3, 9, 3))]
        normal, side = np.swapaxes(J, 1, 2) @ J, np.einsum("krc,kr->kc", J, b)
        radius = _rms(true_p)
        for _ in range(2):
            weights = np.array([1.0, radius, radius, radius]) ** 2
            inverse = np.linalg.pinv(np.tensordot(weights, normal, 1), hermitian=True)
            solution = inverse @ (weights @ side)
            sigmas = np.sqrt(np.square(J @ solution - b).mean(axis=1))
            radius = sigmas[0] / max(sigmas[1:].mean(), LEAST_SIGMA)
        # 2. The rotations next to it.
        A, _ = rotation_between(eye, solution[:9].reshape(3, 3).T)
        turned = np.swapaxes(R, 1, 2) @ (A @ true_R)
        R_rig_body = Rotation.from_matrix(turned).mean().as_matrix() if self.is_turned else eye
        # 3. The lever arm, along axes whose swing exceeds what the errors of the rotations make of it.
        lever, unknown = np.zeros(3), ""
        if self.has_lever:
            swing, moved = R - R.mean(axis=0), true_p @ A.T - p
            error = se3.rotation_log(turned @ R_rig_body.T)
            shown = np.square(swing).mean(axis=0).sum(axis=0) > np.square(error).mean(axis=0).sum() / WORTH_PART
            unknown = "".join(axis for axis, is_shown in zip("xyz", shown, strict=True) if not is_shown)
            lever[shown] = np.linalg.lstsq(swing[:, :, shown].reshape(3 * count, -1), moved.ravel(), rcond=None)[0]
        return se3.transform(R_rig_body, lever), unknown, float(sigmas[0] * sigmas[1:].mean())


def find_truth_frame(estimate: Trajectory, truth: Trajectory) -> TruthFrame | None:
    """Return the simplest difference that explains the error of an estimate; None where none is needed.

    A difference explains an error if no other leaves less than half of it, and if half of the drive shows the
    difference that halves the error of the other half: drift shows none. The rigid transform between the two worlds is
    no difference.
    """
    if _error(estimate, truth) < SMALL_ERROR:
        return None
    # 1. For each convention, without and with a delay, fit all that may differ. Other conventions are tried as long as
    # none leaves a small error.
    general: dict[tuple[str, bool], float] = {}
    for reading in READINGS:
        for has_delay in (False, True):
            general[reading, has_delay], _ = _Model(reading, has_delay, has_lever=True, is_turned=True).fit(
                estimate, truth
            )
        if min(general.values()) < SMALL_ERROR:
            break
    most = max(LEAST_SIGMA, min(general.values())) / WORTH_PART
    if most == np.inf:
        return None
    # 2. Of those that leave little, and of those with fewer unknowns, take the one with the fewest differences.
    good: list[tuple[int, float, _Model, TruthFrame]] = []
    for file in (file for file, error in general.items() if error <= most):
        for body in product((False, True), repeat=2):
            model = _Model(*file, *body)
            error, frame = model.fit(estimate, truth)
            if error <= most:
                good.append((bool(model.reading) + (frame.unit != "m") + sum(model[1:]), error, model, frame))
    changes, _, model, frame = min(good, key=lambda one: one[:2])
    # 3. It must explain the error of each half of the drive by the other half.
    return frame if changes and _is_shown_by_halves(estimate, truth, model) else None


def _is_shown_by_halves(estimate: Trajectory, truth: Trajectory, model: _Model) -> bool:
    """True if what each half of a drive shows explains the other half's error; an error of the spread is the most."""
    middle = len(estimate.stamps_ns) // 2
    halves = [Trajectory(estimate.stamps_ns[part], estimate.T[part]) for part in np.s_[:middle, middle:]]
    left = plain = 0.0
    for one, other in (halves, halves[::-1]):
        of_rig = model.fit(one, truth)[1].rig_poses(truth, other)
        left += _error(_covered(other, of_rig), of_rig) if len(of_rig.stamps_ns) else np.inf
        plain += min(1.0, _error(other, truth))
    return left < WORTH_PART * plain


def _error(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the error that `omnid eval` shows, see `_shown_error`; infinite without poses at the same times."""
    pair = _common(estimate, truth, 0.0)
    return np.inf if pair is None else _shown_error(pair, IDENTITY)


class _Pair(NamedTuple):
    """Poses of an estimate and of its truth at the same times."""

    T_odom_rig: Array  # (N, 4, 4)
    T_truth_body: Array  # (N, 4, 4)
    twists: Array  # (N, 6) of the truth's body [1/s]


def _in_metres(truth: Trajectory, reading: str, unit: str) -> Trajectory:
    """Return a truth that is written in a convention and a unit."""
    R, xyz = parts(READINGS[reading](truth.T))
    return Trajectory(truth.stamps_ns, se3.transform(R, xyz / UNITS[unit]))


def _late(truth: Trajectory, delay_s: float) -> Trajectory:
    """Return a truth, whose stamps are late, on the estimate's clock."""
    return Trajectory(truth.stamps_ns - round(delay_s * 1e9), truth.T)


def _covered(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the part of an estimate that a truth covers."""
    covered = (estimate.stamps_ns >= truth.stamps_ns[0]) & (estimate.stamps_ns <= truth.stamps_ns[-1])
    return Trajectory(estimate.stamps_ns[covered], estimate.T[covered])


def _common(estimate: Trajectory, truth: Trajectory, delay_s: float) -> _Pair | None:
    """Return the estimate's poses that the truth covers, evenly chosen, and the truth interpolated there.

    None where these are fewer than unknowns: three poses have 18 numbers.
    """
    late = _late(truth, delay_s)
    covered = _covered(estimate, late)
    if min(len(covered.stamps_ns), len(truth.stamps_ns)) <= 3:
        return None
    chosen = np.unique(np.linspace(0, len(covered.stamps_ns) - 1, MAX_POSES).astype(int))
    return _Pair(covered.T[chosen], *_at(late, covered.stamps_ns[chosen]))


def _at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the poses (N, 4, 4) of a trajectory at times within it, and its twists (N, 6) [1/s] there."""
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right"), 1, len(trajectory.T) - 1)
    before, T = trajectory.stamps_ns[after - 1], trajectory.T[after - 1]
    twists = se3.log(se3.inverse(T) @ trajectory.T[after]) / ((trajectory.stamps_ns[after] - before) / 1e9)[:, None]
    return T @ se3.exp(twists * ((stamps_ns - before) / 1e9)[:, None]), twists


def _unit(pair: _Pair) -> str:
    """Return the unit of the truth's positions, by their spread against that of the estimate."""
    spread, true_spread = _spread(pair.T_odom_rig), _spread(pair.T_truth_body)
    if min(spread, true_spread) <= 0.0:
        return "m"
    ratio = math.log(true_spread / spread)
    return min(UNITS, key=lambda unit: abs(ratio - math.log(UNITS[unit])))


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
    T, _ = _at(trajectory, np.arange(trajectory.stamps_ns[0], trajectory.stamps_ns[-1] + 1, step_ns))
    translation, rotation = np.split(se3.log(se3.inverse(T[:-1]) @ T[1:]), 2, axis=1)
    rates = [np.linalg.norm(part, axis=1) / (1e-9 * step_ns) for part in (rotation, translation)]
    return np.round(np.column_stack(rates), 6)  # so that rounding is no rate


def _shown_error(pair: _Pair, T_rig_body: Array) -> float:
    """Return the error that `omnid eval` shows, of poses of which the first ones agree.

    It is that of the positions as a fraction of the larger of both spreads, plus that of the rotations [rad].
    """
    T_true = pair.T_truth_body @ se3.inverse(T_rig_body)
    R, xyz = parts(se3.inverse(T_true) @ T_true[0] @ se3.inverse(pair.T_odom_rig[0]) @ pair.T_odom_rig)
    spread_m = max(*(_spread(T) for T in (T_true, pair.T_odom_rig)), LEAST_SIGMA)
    return _rms(xyz) / spread_m + _rms(se3.rotation_log(R))


def _spread(T: Array) -> float:
    """Return how far the positions of poses (N, 4, 4) are from their mean."""
    _, xyz = parts(T)
    return _rms(xyz - xyz.mean(axis=0))


def _rms(vectors: Array) -> float:
    """Return the root of the mean squared length of vectors (N, 3)."""
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))
