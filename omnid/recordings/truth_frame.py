"""What one constant difference between an estimate and its truth explains: body frame, unit, clock, convention.

A truth is often the trajectory of another body on the same robot: a marker, an IMU, a camera. With a constant pose
T_rig_body of that body, and the unknown pose T_truth_odom of the estimate's world, the truth is

    T_truth_body(t + delay) = T_truth_odom T_odom_rig(t) T_rig_body.

Both poses and the delay are fitted by Gauss-Newton in one linearisation: with E = T_odom_rig T_rig_body and the body's
twist v, the residual r = log((T_truth_odom E)^-1 T_truth_body) changes by -Ad(E^-1) a - x + v delay. The same is done
for other conventions in which the file may be written. The simplest difference that explains the error is told, if what
each half of the drive shows of it explains the error of the other half: drift, jumps and other drives show none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.formats.tum import Trajectory

Array = NDArray[np.float64]
# Of two explanations the simpler one is told, unless the other leaves less than this part of its error.
WORTH_PART: Final = 0.5
SMALL_ERROR: Final = 0.02  # in parts of the path's spread, and rad: that of odometry, which needs no explanation
# Units of positions, as the number of them in a metre.
UNITS: Final = {"m": 1.0, "mm": 1e3, "cm": 1e2, "km": 1e-3, "feet": 1 / 0.3048, "inches": 1 / 0.0254}
MAX_POSES: Final = 100  # Poses of a fit, evenly spread: enough for 13 unknowns.
STEPS: Final = 12  # Gauss-Newton steps: a bound, the search ends earlier.
# Prior of T_rig_body: what the path does not show stays near 0.
PRIOR_RAD, PRIOR_M, PRIOR_S = 1.0, 1.0, 1.0
# Samples of the rates of the shorter and of the longer path, at most, for the correlation that finds a delay.
GRID_SAMPLES, MAX_GRID_SAMPLES = 2048, 1 << 17
LEAST_SIGMA: Final = 1e-6  # [m, rad] Residuals of exact poses count as this.


def _with_w_first(T: Array) -> Array:
    """Return poses whose quaternions were read as x y z w, and are w x y z."""
    w_xyz = se3.quaternion(T[:, :3, :3])
    return se3.transform(se3.rotation(np.roll(w_xyz, -1, axis=1)), T[:, :3, 3])


def _with_inverse_rotations(T: Array) -> Array:
    return se3.transform(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])


# How a file may be written, in words, and the poses T_world_body of the poses as they were read.
READINGS: Final[dict[str, Callable[[Array], Array]]] = {
    "": lambda T: T,
    "its quaternions begin with w": _with_w_first,
    "its poses are inverse (T_body_world)": se3.inverse,
    "its rotations are inverse (conjugated quaternions)": _with_inverse_rotations,
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
        T = READINGS[self.reading](truth.T).copy()
        T[:, :3, 3] /= UNITS[self.unit]
        T = T if self.T_rig_body is None else T @ se3.inverse(self.T_rig_body)
        of_rig = Trajectory(truth.stamps_ns - round(self.delay_s * 1e9), T)
        if not self.delay_s:
            return of_rig
        inside = _inside(estimate, of_rig)
        return Trajectory(estimate.stamps_ns[inside], _at(of_rig, estimate.stamps_ns[inside])[0])

    def __str__(self) -> str:
        """Return the differences in one line."""
        parts = [self.reading] if self.reading else []
        if self.unit != "m":
            parts.append(f"its positions are in {self.unit}")
        if self.delay_s:
            parts.append(f"its stamps are {abs(self.delay_s):.3f} s {'later' if self.delay_s > 0 else 'earlier'}")
        if self.T_rig_body is not None:
            x, y, z = self.T_rig_body[:3, 3]
            words = (
                [] if np.array_equal(self.T_rig_body[:3, :3], np.eye(3)) else [f"turned by {_turn(self.T_rig_body)}"]
            )
            if np.any(self.T_rig_body[:3, 3]):
                unknown = f" (the path does not show {self.unknown})" if self.unknown else ""
                words.append(f"at x {x:.3f} y {y:.3f} z {z:.3f} m{unknown}")
            parts.append(f"it is of another body than the rig, {', '.join(words)}")
        return ", ".join(parts)


def _turn(T: Array) -> str:
    """Return a rotation in degrees and its axis."""
    w = se3.rotation_log(T[:3, :3])
    angle_rad = float(np.linalg.norm(w))
    axis = w / max(angle_rad, 1e-12)
    main = int(np.abs(axis).argmax())
    if abs(axis[main]) > math.cos(math.radians(2.0)):
        return f"{math.degrees(angle_rad) * np.sign(axis[main]):.1f} deg about {'xyz'[main]}"
    return f"{math.degrees(angle_rad):.1f} deg about ({axis[0]:.2f} {axis[1]:.2f} {axis[2]:.2f})"


@dataclass(frozen=True, slots=True)
class _Way:
    """A way in which a truth may be written, and what of it is fitted."""

    reading: str  # a key of READINGS
    read: Trajectory
    unit: str  # a key of UNITS
    delay_s: float  # at the start of the fit, if has_delay
    has_delay: bool = False
    is_turned: bool = False
    has_lever: bool = False

    @property
    def changes(self) -> int:
        """Return the number of differences."""
        return (self.reading != "") + (self.unit != "m") + self.has_delay + self.is_turned + self.has_lever

    def fit(self, estimate: Trajectory) -> tuple[float, TruthFrame]:
        """Return the error that is left, see `_shown_error`, and the difference; infinite where nothing is fitted."""
        free = np.repeat([True, self.has_lever, self.is_turned, self.has_delay], [6, 3, 3, 1])
        T = self.read.T.copy()
        T[:, :3, 3] /= UNITS[self.unit]
        truth = Trajectory(self.read.stamps_ns, T)
        pair = _common(estimate, truth, self.delay_s)
        if pair is None:
            return np.inf, TruthFrame()
        starts = _starts(pair) if self.is_turned else [np.eye(4)]
        fits = [_gauss_newton(estimate, truth, self.delay_s, T_rig_body, free) for T_rig_body in starts]
        error, found = min((fit for fit in fits if fit), key=lambda fit: fit[0], default=(np.inf, None))
        return error, TruthFrame() if found is None else TruthFrame(self.reading, self.unit, *found)


def find_truth_frame(estimate: Trajectory, truth: Trajectory) -> TruthFrame | None:
    """Return the simplest difference that explains the error of an estimate; None where none is needed.

    A difference explains an error if no other leaves less than half of it, and if half of the drive shows the
    difference that halves the error of the other half: drift shows none. The rigid transform between the two worlds is
    no difference.
    """
    if min(len(estimate.stamps_ns), len(truth.stamps_ns)) < 4 or _error(estimate, truth) < SMALL_ERROR:
        return None
    # 1. For each convention, without and with a delay, the fit of all that may differ. Another convention is looked for
    # as long as none leaves little.
    general = list[tuple[_Way, float, TruthFrame]]()
    least = np.inf
    for reading, poses in READINGS.items():
        read = Trajectory(truth.stamps_ns, poses(truth.T))
        for has_delay in (False, True):
            delay_s = _delay_s(estimate, read) if has_delay else 0.0
            pair = _common(estimate, read, delay_s)
            if pair is not None:
                way = _Way(reading, read, _unit(pair), delay_s, has_delay, is_turned=True, has_lever=True)
                general.append((way, *way.fit(estimate)))
                least = max(LEAST_SIGMA, min(least, general[-1][1]))
        if least < SMALL_ERROR:
            break
    # 2. Of those that leave little, the fits of less.
    good = [one for one in general if WORTH_PART * one[1] <= least]
    less = [
        replace(way, is_turned=is_turned, has_lever=has_lever)
        for way, _, _ in good
        for is_turned, has_lever in ((False, False), (True, False), (False, True))
    ]
    good += [(way, error, frame) for way in less for error, frame in [way.fit(estimate)] if WORTH_PART * error <= least]
    # 3. The simplest that explains the error, and that of each half of the drive by the other half.
    if not good:
        return None
    way, _, frame = min(good, key=lambda one: (one[0].changes, one[1]))
    return frame if way.changes and _is_shown_by_halves(estimate, truth, way) else None


def _is_shown_by_halves(estimate: Trajectory, truth: Trajectory, way: _Way) -> bool:
    """True if what each half of a drive shows explains the other half's error; one of the whole spread is the most."""
    middle = len(estimate.stamps_ns) // 2
    halves = [Trajectory(estimate.stamps_ns[part], estimate.T[part]) for part in np.s_[:middle, middle:]]
    left = plain = 0.0
    for one, other in (halves, halves[::-1]):
        of_rig = way.fit(one)[1].rig_poses(truth, other)
        if not len(of_rig.stamps_ns):
            return False
        covered = _inside(other, of_rig)
        same = Trajectory(other.stamps_ns[covered], other.T[covered])
        left, plain = left + _error(same, of_rig), plain + min(1.0, _error(same, truth))
    return left < WORTH_PART * plain


def _error(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the error that `omnid eval` shows, see `_shown_error`; infinite without poses at the same times."""
    pair = _common(estimate, truth, 0.0)
    return np.inf if pair is None else _shown_error(pair, np.eye(4))


@dataclass(frozen=True, slots=True)
class _Pair:
    """Poses of an estimate and of its truth at the same times."""

    T_odom_rig: Array  # (N, 4, 4)
    T_truth_body: Array  # (N, 4, 4)
    twists: Array  # (N, 6) of the truth's body [1/s]


def _common(estimate: Trajectory, truth: Trajectory, delay_s: float) -> _Pair | None:
    """Return the estimate's poses that the truth covers, evenly chosen, and the truth interpolated there."""
    late = Trajectory(truth.stamps_ns - round(delay_s * 1e9), truth.T)
    inside = _inside(estimate, late)
    if len(inside) < 4:
        return None
    chosen = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_POSES).astype(int))]
    return _Pair(estimate.T[chosen], *_at(late, estimate.stamps_ns[chosen]))


def _inside(estimate: Trajectory, truth: Trajectory) -> NDArray[np.intp]:
    """Return the numbers of an estimate's poses that a truth covers."""
    stamps_ns, true_ns = estimate.stamps_ns, truth.stamps_ns
    return np.flatnonzero((stamps_ns >= true_ns[0]) & (stamps_ns <= true_ns[-1]))


def _at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the poses (N, 4, 4) of a trajectory at times within it, and its twists (N, 6) [1/s] there."""
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right"), 1, len(trajectory.T) - 1)
    before, T = trajectory.stamps_ns[after - 1], trajectory.T[after - 1]
    twists = se3.log(se3.inverse(T) @ trajectory.T[after]) / ((trajectory.stamps_ns[after] - before) / 1e9)[:, None]
    return T @ se3.exp(twists * ((stamps_ns - before) / 1e9)[:, None]), twists


def _seconds(trajectory: Trajectory, origin: Trajectory) -> Array:
    """Return stamps (N,) [s] from the first one of a trajectory on."""
    return np.asarray((trajectory.stamps_ns - origin.stamps_ns[0]) / 1e9)


def _unit(pair: _Pair) -> str:
    """Return the unit of the truth's positions, by their spread against that of the estimate."""
    spread, true_spread = _spread(pair.T_odom_rig), _spread(pair.T_truth_body)
    if min(spread, true_spread) <= 0.0:
        return "m"
    ratio = math.log(true_spread / spread)
    return min(UNITS, key=lambda unit: abs(ratio - math.log(UNITS[unit])))


def _delay_s(estimate: Trajectory, truth: Trajectory) -> float:
    """Return how late the truth's stamps are [s], by the best correlation of the rates of turning and of the speeds.

    Both are the same for every body fixed to the robot, but for the lever arm's part of the speed. Overlaps of less
    than half of the shorter one are not tried.
    """
    spans_s = [float(_seconds(one, one)[-1]) for one in (estimate, truth)]
    periods_s = [span / (len(one.T) - 1) for span, one in zip(spans_s, (estimate, truth), strict=True)]
    step_s = max(*periods_s, min(spans_s) / GRID_SAMPLES, max(spans_s) / MAX_GRID_SAMPLES)
    rates, rates_of_truth = (_rates(one, step_s) for one in (estimate, truth))
    shifts = np.arange(1 - len(rates), len(rates_of_truth))
    overlap = np.minimum(shifts + len(rates), len(rates_of_truth)) - np.maximum(shifts, 0)
    score = np.zeros(len(shifts))
    for ours, theirs in zip(rates.T, rates_of_truth.T, strict=True):
        score += _correlation(theirs, ours, overlap)
    score[overlap < 0.5 * min(len(rates), len(rates_of_truth))] = -np.inf
    return float(_seconds(truth, estimate)[0]) + float(shifts[score.argmax()]) * step_s


def _rates(trajectory: Trajectory, step_s: float) -> Array:
    """Return the rate of turning and the speed (N, 2) at times a step apart."""
    at_s = _seconds(trajectory, trajectory)
    grid_s = np.arange(0.0, at_s[-1], step_s)
    nearest = np.clip(np.searchsorted(at_s, grid_s), 0, len(at_s) - 1)
    twists = se3.log(se3.inverse(trajectory.T[nearest[:-1]]) @ trajectory.T[nearest[1:]])
    passed_s = np.maximum(at_s[nearest[1:]] - at_s[nearest[:-1]], 1e-9)[:, None]
    return np.column_stack([np.linalg.norm(twists[:, 3:], axis=1), np.linalg.norm(twists[:, :3], axis=1)]) / passed_s


def _correlation(theirs: Array, ours: Array, overlap: Array) -> Array:
    """Return Pearson's correlation at every shift of one signal against the other; 0 where one is constant."""
    ones, own_ones = np.ones(len(theirs)), np.ones(len(ours))

    def sums(a: Array, b: Array) -> Array:
        size = 1 << (len(a) + len(b) - 1).bit_length()
        both = np.fft.rfft(a, size) * np.fft.rfft(b[::-1], size)
        return np.asarray(np.fft.irfft(both, size)[: len(a) + len(b) - 1])

    theirs, ours = theirs - theirs.mean(), ours - ours.mean()
    count = np.maximum(overlap, 1.0)
    mean, own_mean = sums(theirs, own_ones) / count, sums(ones, ours) / count
    variance = sums(theirs**2, own_ones) / count - mean**2
    own_variance = sums(ones, ours**2) / count - own_mean**2
    product = variance * own_variance
    least = 1e-9 * float((theirs**2).mean() * (ours**2).mean())
    with np.errstate(all="ignore"):
        found = (sums(theirs, ours) / count - mean * own_mean) / np.sqrt(product)
    return np.where(product > least, found, 0.0)


def _starts(pair: _Pair) -> list[Array]:
    """Return start values of T_rig_body: none, and its rotation by the positions or by the rotations of the path."""
    starts = [np.eye(4)]
    ours, theirs = pair.T_odom_rig, pair.T_truth_body
    # 1. The world's rotation by the positions, as without a lever arm; then the mean rotation that is left.
    R_world = _rotation_between(
        ours[:, :3, 3] - ours[:, :3, 3].mean(axis=0), theirs[:, :3, 3] - theirs[:, :3, 3].mean(axis=0)
    )
    left = np.swapaxes(R_world @ ours[:, :3, :3], 1, 2) @ theirs[:, :3, :3]
    u, _, vt = np.linalg.svd(left.sum(axis=0))
    starts.append(se3.transform(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt, np.zeros(3)))
    # 2. The body's rotation by those of the path: log(R_truth) = R_rig_body^T log(R_odom) for each part of it.
    reach = max(1, len(ours) // 8)
    turns, own_turns = (
        se3.rotation_log(np.swapaxes(T[:-reach, :3, :3], 1, 2) @ T[reach:, :3, :3]) for T in (theirs, ours)
    )
    starts.append(se3.transform(_rotation_between(turns, own_turns), np.zeros(3)))
    return starts


def _rotation_between(a: Array, b: Array) -> Array:
    """Return the rotation R (3, 3) with b = R a for vectors (N, 3), by least squares (Kabsch)."""
    u, _, vt = np.linalg.svd(b.T @ a)
    return np.asarray(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)


def _gauss_newton(
    estimate: Trajectory, truth: Trajectory, delay_s: float, T_rig_body: Array, free: NDArray[np.bool_]
) -> tuple[float, tuple[float, Array | None, int, str]] | None:
    """Return the error that is left, and delay, T_rig_body, number of fitted unknowns and unknown axes.

    free (13,): the unknowns that are fitted: T_truth_odom, lever arm and rotation of T_rig_body, delay.
    """
    pair = _common(estimate, truth, delay_s)
    if pair is None:
        return None
    middle = len(pair.T_odom_rig) // 2
    T_truth_odom = pair.T_truth_body[middle] @ se3.inverse(pair.T_odom_rig[middle] @ T_rig_body)
    begun_s, normal, prior = delay_s, np.eye(int(free.sum())), np.eye(int(free.sum()))
    for _ in range(STEPS):
        # 1. Residuals (N, 6), and their standard deviations in translation and in rotation.
        E = pair.T_odom_rig @ T_rig_body
        r = se3.log(se3.inverse(T_truth_odom @ E) @ pair.T_truth_body)
        sigma = [max(_rms(part) / math.sqrt(3), LEAST_SIGMA) for part in (r[:, :3], r[:, 3:])]
        weight = 1 / np.repeat(sigma, 3)
        # 2. The derivatives (N, 6, 13) by T_truth_odom, T_rig_body and the delay. Errors of the rotations would count
        # as a swing of the lever arm: its prior holds as much against it.
        N = len(r)
        lever = PRIOR_M**-2 + 2 * N * (sigma[1] / sigma[0]) ** 2
        prior = np.diag(np.repeat([0.0, lever, PRIOR_RAD**-2, PRIOR_S**-2], [6, 3, 3, 1]))[np.ix_(free, free)]
        J = (
            np.concatenate(
                [se3.adjoint(se3.inverse(E)), np.broadcast_to(np.eye(6), (N, 6, 6)), -pair.twists[:, :, None]], axis=2
            )[:, :, free]
            * weight[:, None]
        )
        # 3. The step, with the priors of the body's pose and of the delay.
        state = np.concatenate([np.zeros(6), se3.log(T_rig_body), [delay_s - begun_s]])[free]
        normal = np.einsum("nri,nrj->ij", J, J)
        gradient = np.einsum("nri,nr->i", J, r * weight) - prior @ state
        step = np.zeros(13)
        step[free] = np.linalg.lstsq(normal + prior + 1e-9 * np.diag(np.diag(normal) + 1.0), gradient, rcond=None)[0]
        T_truth_odom, T_rig_body = T_truth_odom @ se3.exp(step[:6]), T_rig_body @ se3.exp(step[6:12])
        if free[12]:
            delay_s += float(np.clip(step[12], -0.5, 0.5))
            moved = _common(estimate, truth, delay_s)
            if moved is None:
                return None
            pair = moved
        if np.linalg.norm(step) < LEAST_SIGMA:
            break
    determined, unknown = _determined(normal, prior, free)
    is_rig = not free[6:12].any()
    return _shown_error(pair, T_rig_body), (delay_s, None if is_rig else T_rig_body, determined, unknown)


def _shown_error(pair: _Pair, T_rig_body: Array) -> float:
    """Return the error that `omnid eval` shows, of poses of which the first ones agree.

    It is that of the positions in parts of the larger of both spreads, plus that of the rotations [rad].
    """
    T_true = pair.T_truth_body @ se3.inverse(T_rig_body)
    off = se3.inverse(T_true) @ T_true[0] @ se3.inverse(pair.T_odom_rig[0]) @ pair.T_odom_rig
    spread_m = max(*(_spread(T) for T in (T_true, pair.T_odom_rig)), LEAST_SIGMA)
    return _rms(off[:, :3, 3]) / spread_m + _rms(se3.rotation_log(off[:, :3, :3]))


def _spread(T: Array) -> float:
    """Return how far the positions of poses (N, 4, 4) are from their mean."""
    return _rms(T[:, :3, 3] - T[:, :3, 3].mean(axis=0))


def _rms(vectors: Array) -> float:
    """Return the root of the mean squared length of vectors (N, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _determined(normal: Array, prior: Array, free: NDArray[np.bool_]) -> tuple[int, str]:
    """Return the number of unknowns besides T_truth_odom that the path determines, and the axes that it does not."""
    if not free[6:].any():
        return 0, ""
    # The world's transform is eliminated.
    S = normal[6:, 6:] - normal[6:, :6] @ np.linalg.pinv(normal[:6, :6], hermitian=True) @ normal[:6, 6:]
    posterior = np.linalg.inv(S + prior[6:, 6:])
    known = 1 - np.diag(posterior @ prior[6:, 6:])
    axes = [name for name, part in zip("xyz", known, strict=False) if free[6] and part < WORTH_PART]
    return round(float(known.sum())), ", ".join(axes)
