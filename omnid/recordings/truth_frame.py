"""What one constant difference between an estimate and its truth explains: body frame, unit, clock, convention.

A truth is often the trajectory of another body on the same robot: a marker, an IMU, a camera. With a constant pose
T_rig_body of that body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body(t + delay) = T_truth_odom T_odom_rig(t) T_rig_body.

Both poses and the delay are fitted by Gauss-Newton in one linearisation: with E = T_odom_rig T_rig_body and the body's
twist v, the residual r = log((T_truth_odom E)^-1 T_truth_body) changes by -Ad(E^-1) a - x + v delay. The same is done
for other conventions in which the file may be written. The simplest difference that explains the error is reported, if
what each half of the drive shows of it explains the error of the other half: drift, jumps and other drives show none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import cv2
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
# Units of positions, as the number of them in a metre.
UNITS: Final = {"m": 1.0, "mm": 1e3, "cm": 1e2, "km": 1e-3, "feet": 1 / 0.3048, "inches": 1 / 0.0254}
MAX_POSES: Final = 100  # Poses of a fit, evenly spread, for the 13 unknowns.
STEPS: Final = 12  # Gauss-Newton steps: a bound, the search ends earlier.
IDENTITY: Final = np.eye(4)
LEAST_SIGMA: Final = 1e-6  # [m, rad] Residuals of exact poses count as this.
SIZES: Final = (6, 3, 3, 1)  # numbers of unknowns: T_truth_odom, lever arm and rotation of T_rig_body, delay


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
    """What may differ: the convention of the file, and the unknowns that are fitted."""

    reading: str  # a key of READINGS
    has_delay: bool
    has_lever: bool
    is_turned: bool

    def simpler(self) -> Iterator[_Model]:
        """Yield this model and those of the same clock and convention with fewer unknowns."""
        yield from (_Model(self.reading, self.has_delay, *body) for body in product((False, True), repeat=2))

    def fit(self, estimate: Trajectory, truth: Trajectory) -> tuple[float, TruthFrame]:
        """Return the error that is left, see `_shown_error`, and the difference; infinite where nothing is fitted."""
        free = np.repeat([True, self.has_lever, self.is_turned, self.has_delay], SIZES)
        read = _in_metres(truth, self.reading, "m")
        delay_s = _delay_s(estimate, read) if self.has_delay else 0.0
        pair = _common(estimate, read, delay_s)
        if pair is None:
            return np.inf, TruthFrame()
        unit = _unit(pair)
        scaled = _in_metres(truth, self.reading, unit)
        starts = [IDENTITY, *(_rotated_starts(pair) if self.is_turned else [])]
        fits = [_gauss_newton(estimate, scaled, delay_s, T_rig_body, free) for T_rig_body in starts]
        error, found = min((fit for fit in fits if fit), key=lambda fit: fit[0], default=(np.inf, None))
        return error, TruthFrame() if found is None else TruthFrame(self.reading, unit, *found)


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
    general: dict[_Model, float] = {}
    for reading in READINGS:
        for has_delay in (False, True):
            model = _Model(reading, has_delay, has_lever=True, is_turned=True)
            general[model], _ = model.fit(estimate, truth)
        if min(general.values()) < SMALL_ERROR:
            break
    least = max(LEAST_SIGMA, min(general.values()))
    if least == np.inf:
        return None
    # 2. Of those that leave little, and of those with fewer unknowns, take the one with the fewest differences.
    good: list[tuple[int, float, _Model, TruthFrame]] = []
    for model in [
        simpler for one, error in general.items() if WORTH_PART * error <= least for simpler in one.simpler()
    ]:
        error, frame = model.fit(estimate, truth)
        if WORTH_PART * error <= least:
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


def _delay_s(estimate: Trajectory, truth: Trajectory) -> float:
    """Return how late the truth's stamps are [s], by the best correlation of the rates of turning and of the speeds.

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
    return 1e-9 * (begins_apart_ns + (shift_ns if longer is theirs else -shift_ns))


def _rates(trajectory: Trajectory, step_ns: int) -> Array:
    """Return the rate of turning [rad/s] and the speed [m/s] (N, 2) at times a step apart."""
    T, _ = _at(trajectory, np.arange(trajectory.stamps_ns[0], trajectory.stamps_ns[-1] + 1, step_ns))
    translation, rotation = np.split(se3.log(se3.inverse(T[:-1]) @ T[1:]), 2, axis=1)
    rates = [np.linalg.norm(part, axis=1) / (1e-9 * step_ns) for part in (rotation, translation)]
    return np.round(np.column_stack(rates), 6)  # so that rounding is no rate


def _rotated_starts(pair: _Pair) -> list[Array]:
    """Return start values of T_rig_body: its rotation by the positions and by the rotations of the path."""
    (R, xyz), (true_R, true_xyz) = parts(pair.T_odom_rig), parts(pair.T_truth_body)
    # 1. The world's rotation by the positions, as without a lever arm; then the mean rotation that is left.
    R_world, _ = rotation_between(xyz - xyz.mean(axis=0), true_xyz - true_xyz.mean(axis=0))
    by_positions = Rotation.from_matrix(np.swapaxes(R_world @ R, 1, 2) @ true_R).mean().as_matrix()
    # 2. The body's rotation by those of the path: log(R_truth) = R_rig_body^T log(R_odom) for each part of it.
    reach = max(1, len(R) // 8)
    turns, true_turns = (se3.rotation_log(np.swapaxes(part[:-reach], 1, 2) @ part[reach:]) for part in (R, true_R))
    by_rotations, _ = rotation_between(true_turns, turns)
    return [se3.transform(found, np.zeros(len(found))) for found in (by_positions, by_rotations)]


def _gauss_newton(
    estimate: Trajectory, truth: Trajectory, delay_s: float, T_rig_body: Array, free: NDArray[np.bool_]
) -> tuple[float, tuple[float, Array | None, int, str]] | None:
    """Return the error that is left, and delay, T_rig_body, number of fitted unknowns and unknown axes.

    free (13,): the unknowns that are fitted: T_truth_odom, lever arm and rotation of T_rig_body, delay.
    """
    pair = _common(estimate, truth, delay_s)
    if pair is None:
        return None
    middle, ends, begun_s = len(pair.T_odom_rig) // 2, np.cumsum(SIZES)[:-1], delay_s
    T_truth_odom = pair.T_truth_body[middle] @ se3.inverse(pair.T_odom_rig[middle] @ T_rig_body)
    for _ in range(STEPS):
        # 1. Residuals (N, 6), and their standard deviations in translation and in rotation.
        E = pair.T_odom_rig @ T_rig_body
        r = se3.log(se3.inverse(T_truth_odom @ E) @ pair.T_truth_body)
        sigma = [max(float(np.sqrt(np.square(part).mean())), LEAST_SIGMA) for part in np.split(r, 2, axis=1)]
        weight = 1 / np.repeat(sigma, r.shape[1] // 2)
        # 2. The derivatives (N, 6, 13) by T_truth_odom, T_rig_body and the delay. What the path does not show of the
        # pose and the delay stays near 0 by a prior of 1 m, 1 rad and 1 s. Errors of the rotations would count as a
        # swing of the lever arm: its prior holds as much against it.
        by_body = np.broadcast_to(np.eye(r.shape[1]), (len(r), r.shape[1], r.shape[1]))
        J = np.concatenate([se3.adjoint(se3.inverse(E)), by_body, -pair.twists[:, :, None]], axis=2)
        J = J[:, :, free] * weight[:, None]
        lever = 1 + 2 * len(r) * (sigma[1] / sigma[0]) ** 2
        prior = np.diag(np.repeat([0.0, lever, 1.0, 1.0], SIZES)[free])
        # 3. The step.
        state = np.concatenate([np.zeros(SIZES[0]), se3.log(T_rig_body), [delay_s - begun_s]])[free]
        normal = np.einsum("nri,nrj->ij", J, J) + prior
        step = np.zeros(len(free))
        step[free] = np.linalg.pinv(normal, hermitian=True) @ (np.einsum("nri,nr->i", J, r * weight) - prior @ state)
        world, lever_arm, turn, delay = np.split(step, ends)
        T_truth_odom, T_rig_body = T_truth_odom @ se3.exp(world), T_rig_body @ se3.exp(np.r_[lever_arm, turn])
        if free[-1]:
            delay_s += float(np.clip(delay[0], -0.5, 0.5))
            moved = _common(estimate, truth, delay_s)
            if moved is None:
                return None
            pair = moved
        if np.linalg.norm(step) < LEAST_SIGMA:
            break
    # 4. The share of each unknown that the path determines, and not the prior.
    known = np.zeros(len(free))
    known[free] = 1 - np.diag(np.linalg.pinv(normal, hermitian=True) @ prior)
    of_world, of_lever, *_ = np.split(known, ends)
    _, is_lever, is_turn, _ = np.split(free, ends)
    unknown = [axis for axis, part in zip("xyz", of_lever, strict=True) if is_lever[0] and part < WORTH_PART]
    T_found = T_rig_body if is_lever[0] or is_turn[0] else None
    freedom = round(float(known.sum() - of_world.sum()))
    return _shown_error(pair, T_rig_body), (delay_s, T_found, freedom, ", ".join(unknown))


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
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
