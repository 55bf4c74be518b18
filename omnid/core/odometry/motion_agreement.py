"""Do images, wheels and gyro show the same motion at the same time? Windowed sums of their innovations.

Images that arrive late, play slowly, or are of a rig of another size track well, and so do wheels of another radius:
each sensor is consistent in itself. The comparison of all three is not:

    distance  of images and wheels
    turn      of images, wheels and gyro, each with each

1. Delay. For lags l from -0.5 to 1.5 s, J(l) = min_s sum (s D(start - l, end - l) - seen)^2 over the steps of the last
   10 s, D the motion by a sensor. The smallest J(l) is compared with the smallest one within 0.3 s of 0: their
   difference, divided by the variance of the residuals, is the evidence (a likelihood ratio). A steady motion has none.
2. Scale. The motion of the sensor and of the images is summed over the newest 3 m or 10 s, whichever is shorter, at the
   likeliest lag within 0.3 s.
3. Direction, by the same sums. Wheels roll forwards: if the images show motion to the side while the base drives
   straight on, the yaw of the rig on the base is not that of T_base_rig.

A sensor that differs from two others, which agree, is wrong; of two it is unknown which one is. A difference of
DOUBT_SHARE of its limit is a doubt, the whole limit a fault. After STILL_S at rest everything is forgotten: a person
may arm and try again.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, WheelSample
from omnid.core.control.motion_monitor import (
    AGREE,
    GYRO_DIFFERS,
    IMAGES_ASIDE,
    IMAGES_DIFFER,
    IMAGES_OR_GYRO,
    IMAGES_OR_WHEELS,
    MAX_MOTIONS,
    WHEELS_DIFFER,
    Conflict,
    Difference,
)
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.motion_hypotheses import DECIDING_COST

Array = NDArray[np.float64]
Kind = Literal["distance", "turn", "aside"]  # what is compared; no sensor knows a motion to the side

# Window of the sums, and allowed differences: 0.3 s are 0.15 m at 0.5 m/s, the distance that the collision monitor
# keeps; 10 % of 3 m are twice that.
WINDOW_S, WINDOW_M, SCALE_SHARE, ALLOWED_LAG_S = 10.0, 3.0, 0.1, 0.3
# Lags that are compared, and least time between two comparisons: drivers of cameras buffer images for a second or so.
LAG_STEP_S: Final = 0.05
LAGS_S: Final = np.arange(-0.5, 1.5 + LAG_STEP_S / 2, LAG_STEP_S)
DOUBT_SHARE: Final = 0.5  # Share of a limit from which on the base drives slowly; by trial on development seeds.
# Limits for a doubt in the newest second alone, 0.1 m and a third of the way: images that play at half of the speed
# show half of it.
SOON_S, SOON_M, SOON_SHARE = 1.0, 0.1, 1 / 3
# Allowed motion to the side as a share of the way: the distance of the collision monitor, 0.15 m, after a metre. In a
# curve with more turn than STRAIGHT_RADPM an offset of the rig also moves to the side.
ASIDE_SHARE, STRAIGHT_RADPM = 0.15, 0.1
# Least differences of sums: an allowed delay moves a base of 0.2 m/s so far; a gyro's bias is estimated to less than
# half a degree a second; wheels whose diameters differ by 0.7 % turn by 4 degrees over 3 m, which is no doubt yet.
LEAST_M, TURN_RAD, WHEEL_TURN_RAD = 0.05, math.radians(5.0), math.radians(15.0)
STEP_SIGMA: Final = 0.003  # m and rad of a step, added to that of its residuals: roughness of floor and images
WORSE: Final = 3.0  # ratio of the sums of squares that the lag must explain, because slip makes both of them large
LATE_S: Final = 0.5  # A lag is a fault after this time, because the newest steps are the noisiest.
SCALES: Final = (0.3, 3.0)  # Scales of the motion in the search of a lag, because images may be slow as well as late.
STILL_S, STILL_M, STILL_RAD = 2.0, 0.02, 0.04  # Limits of rest, because 1 cm/s and a degree a second are noise.
LEAST_STEPS: Final = 8  # Steps that are needed for a comparison, because fewer show no delay.


class _Finding(NamedTuple):
    """Comparison of one sensor with the images, or of wheels with the gyro."""

    is_known: bool = False
    excess: float = 0.0  # difference of the sums as a fraction of its limit; 1 and more is a fault
    text: str = ""
    difference: Difference = Difference()  # empty where the images are late
    is_late: bool = False  # by more than is allowed

    @property
    def differs(self) -> bool:
        """True if it is at least a doubt."""
        return self.is_late or self.excess >= DOUBT_SHARE


class MotionAgreement:
    """Compares images, wheels and gyro at each pair; memory and work are bounded."""

    def __init__(self, motion: MotionFilter) -> None:
        """motion: the filter, with the samples of wheels and gyro."""
        # Starts and ends [s] of steps of the base, distance ahead [m], turn [rad], lateral distance [m] by the cameras.
        self._steps: deque[tuple[float, float, float, float, float]] = deque(maxlen=MAX_MOTIONS)
        self._motion = motion
        self._compared_s = -math.inf
        self._late_since_s: float | None = None
        self.result = AGREE

    def add_step(self, start_ns: int, end_ns: int, distance_m: float, turn_rad: float, aside_m: float = 0.0) -> None:
        """Add the motion of the base from one pair to the next, as the cameras saw it; compare.

        aside_m: along its y axis.
        """
        seconds = self._motion.sensors.seconds
        end_s = seconds(end_ns)
        self._steps.append((seconds(start_ns), end_s, distance_m, turn_rad, aside_m))
        self._forget_before(end_s - WINDOW_S)
        if end_s - self._compared_s < LAG_STEP_S:
            return
        self._compared_s = end_s
        starts, ends, *seen = np.array(self._steps).T
        if self._is_at_rest(starts, ends, *seen[:2]):
            self._forget_before(end_s - STILL_S)
            self._late_since_s, self.result = None, AGREE
        elif len(self._steps) >= LEAST_STEPS:
            self.result = self._compare(starts, ends, *seen)

    def _forget_before(self, time_s: float) -> None:
        while self._steps and self._steps[0][1] < time_s:
            self._steps.popleft()

    def _compare(self, starts: Array, ends: Array, ways: Array, turns: Array, lateral: Array) -> Conflict:
        """Return the sensor that differs, and whether it is a fault, by steps (N,) of the cameras."""
        # 1. Each sensor against the images; for the wheels the worse one of distance and turn counts.
        lagged = starts - LAGS_S[:, None], ends - LAGS_S[:, None]
        wheels_by_lag = self._motion.sensors.motion(WheelSample, *lagged, self._motion.values)
        gyro_by_lag = self._motion.sensors.motion(GyroSample, *lagged, self._motion.values)[..., 2]
        spans = starts, ends, ways
        distance = _finding(spans, ways, wheels_by_lag[..., 0], LEAST_M, "distance")
        of_wheels = _finding(spans, turns, wheels_by_lag[..., 1], WHEEL_TURN_RAD, "turn")
        of_gyro = _finding(spans, turns, gyro_by_lag, TURN_RAD, "turn")
        wheels = max((distance, of_wheels), key=lambda found: (found.differs, found.excess, found.is_late))
        # 2. Which one differs from the others.
        if not wheels.differs and not of_gyro.differs:
            self._late_since_s = None
            if not distance.is_known:
                return AGREE
            is_straight = (np.abs(turns) <= STRAIGHT_RADPM * np.abs(ways)) & (np.abs(lateral) < np.abs(ways))
            straight = np.where(is_straight, lateral * np.sign(ways), np.nan)
            aside = _finding(spans, straight, np.zeros((len(LAGS_S), len(ways))), LEAST_M, "aside")
            return Conflict(IMAGES_ASIDE, aside.text, aside.excess >= 1.0) if aside.differs else AGREE
        if wheels.differs and of_gyro.differs:
            reason, found = IMAGES_DIFFER, max(wheels, of_gyro, key=lambda found: found.excess)
        elif wheels.differs:
            # The gyro knows nothing of distances.
            reason, found = WHEELS_DIFFER if of_wheels.differs and of_gyro.is_known else IMAGES_OR_WHEELS, wheels
        else:
            between = _finding(spans, gyro_by_lag[_NO_LAG], wheels_by_lag[..., 1], WHEEL_TURN_RAD, "turn")
            is_alone = of_wheels.is_known and between.excess >= of_wheels.excess
            reason, found = GYRO_DIFFERS if is_alone else IMAGES_OR_GYRO, of_gyro
        # 3. Wheels that turn otherwise than both images and gyro are wrong: a weak motor, another radius. The pose is
        #    right, so the base drives on slowly. Neither a distance nor a delay is confirmed by a third sensor.
        now_s = float(ends[-1])
        self._late_since_s = (self._late_since_s or now_s) if found.is_late else None
        is_long = self._late_since_s is not None and now_s - self._late_since_s >= LATE_S
        is_explained = reason == WHEELS_DIFFER and not found.is_late and distance.excess < 1.0
        is_fault = is_long or (found.excess >= 1.0 and not is_explained)
        turn = of_gyro if of_gyro.differs else of_wheels
        differences = (each.difference if each.differs else Difference() for each in (distance, turn))
        return Conflict(reason, found.text, is_fault, *differences)

    def _is_at_rest(self, starts: Array, ends: Array, ways: Array, turns: Array) -> bool:
        """True if images and wheels have shown no motion for STILL_S."""
        now_s, newest = float(ends[-1]), ends > ends[-1] - STILL_S
        if starts[0] > now_s - STILL_S:
            return False
        start_s, end_s = np.array(now_s - STILL_S), np.array(now_s - LAG_STEP_S)
        by_wheels = self._motion.sensors.motion(WheelSample, start_s, end_s, self._motion.values)
        by_images = np.array([ways[newest].sum(), turns[newest].sum()])
        # Wheels without samples (NaN) count as at rest.
        return not any((np.abs(each) > (STILL_M, STILL_RAD)).any() for each in (by_images, by_wheels))


_NO_LAG: Final = int(np.argmin(np.abs(LAGS_S)))


def _finding(spans: tuple[Array, Array, Array], seen: Array, by_lag: Array, least: float, kind: Kind) -> _Finding:
    """Compare the motion seen (N,) in steps with that of a sensor at all lags (L, N), both in metres or radians.

    spans: starts, ends [s] and ways [m] of the steps. least: difference of the sums that is a fault. NaN: not known.
    """
    starts, ends, ways = spans
    # 1. Delay; the newest steps have no samples of later times yet.
    known, at_lag = np.isfinite(by_lag).all(axis=0) & np.isfinite(seen), _NO_LAG
    if known.sum() >= LEAST_STEPS:
        best, at_lag, is_late = _lag(by_lag[:, known], seen[known])
        if is_late:
            return _Finding(is_known=True, text=f"by {abs(LAGS_S[best]):.1f} s", is_late=True)
    known = np.isfinite(by_lag[at_lag]) & np.isfinite(seen)
    if known.sum() < LEAST_STEPS:
        return _Finding()
    # 2. Scale: both sums over the newest steps, at the likeliest of the allowed lags.
    newest = np.flatnonzero(known)[::-1]
    moved, seen, times_s = by_lag[at_lag][newest], seen[newest], (ends - starts)[newest]
    way = np.cumsum(np.abs(ways[newest]))
    path = way if kind == "aside" else np.cumsum(np.abs(moved))
    count = int(np.searchsorted(path if kind == "distance" else way, WINDOW_M)) + 1
    length, apart = float(path[:count][-1]), float((moved - seen)[:count].sum())
    difference = Difference(apart, float(times_s[:count].sum()))
    # 3. The limit: a share of the way, and the motion within the lag that is in order.
    is_whole = count <= len(path) or ends[-1] - starts[0] >= WINDOW_S - LEAST_STEPS * LAG_STEP_S or kind == "turn"
    limit = max((ASIDE_SHARE if kind == "aside" else SCALE_SHARE) * (length if is_whole else WINDOW_M), least)
    limit += ALLOWED_LAG_S / 3 * float((np.abs(seen) / np.maximum(times_s, LAG_STEP_S / 5)).max())
    excess = abs(apart) / limit
    # 4. Of a distance the newest second alone as well, which may show a doubt sooner.
    if kind == "distance":
        soon = int(np.searchsorted(ends[-1] - ends[newest], SOON_S))
        lacking = abs(float((moved - seen)[:soon].sum()))
        if excess < 1.0 and lacking > max(SOON_M, SOON_SHARE * float(np.abs(moved[:soon]).sum())):
            return _Finding(True, max(DOUBT_SHARE, excess), f"by {lacking:.2f} m in {SOON_S:.0f} s", difference)
    angle_deg = math.degrees(math.atan2(abs(apart), length) if kind == "aside" else abs(apart))
    shown = f"{abs(apart):.2f} m in {length:.1f} m" if kind == "distance" else f"{angle_deg:.0f} degrees"
    return _Finding(True, excess, f"by {shown}", difference)


def _lag(by_lag: Array, seen: Array) -> tuple[int, int, bool]:
    """Return the best lag, the best one that is allowed, and whether the evidence for the other is strong."""
    scale = np.clip((by_lag @ seen) / np.maximum((by_lag**2).sum(axis=1), 1e-12), *SCALES)
    squares = ((scale[:, None] * by_lag - seen) ** 2).sum(axis=1)
    allowed = np.flatnonzero(np.abs(LAGS_S) <= ALLOWED_LAG_S + LAG_STEP_S / 2)
    best = int(np.argmin(squares))
    variance = squares[best] / len(seen) + STEP_SIGMA**2
    # Of a steady motion any lag is as good: without evidence it is near 0.
    near = int(allowed[np.argmin((squares + variance * (3 * LAGS_S / ALLOWED_LAG_S) ** 2)[allowed])])
    is_strong = squares[near] - squares[best] > 2 * DECIDING_COST * variance and squares[near] > WORSE * squares[best]
    return best, near, bool(is_strong and best not in allowed)


class Contradiction:
    """Covariance of the pose by the difference between the images and the wheels or gyro that contradict them.

    The difference in a fault stays when they agree again, since later images do not correct a wrong pose. That of a
    doubt ends with the doubt.
    """

    def __init__(self) -> None:
        self._faults = np.zeros(6)  # displacement [t; r] as a twist in odom
        self._fault_s = -math.inf  # time of the last fault

    def add(self, conflict: Conflict, T_odom_base: Array, time_s: float) -> Array:
        """Add the difference at a pose; return its covariance (6, 6) in the axes of the base."""
        # The sums overlap from pair to pair: only their part since the last fault is new. Ways and turns in it are so
        # short that their order does not matter.
        seconds, to_odom = time_s - self._fault_s, se3.adjoint(T_odom_base)
        new = to_odom @ [conflict.distance.part(seconds), 0.0, 0.0, 0.0, 0.0, conflict.turn.part(seconds)]
        is_fault = conflict.contradicts_images and conflict.is_fault
        whole = self._faults + new if conflict.contradicts_images else self._faults
        if is_fault:
            self._faults, self._fault_s = whole, time_s
        displacement = se3.adjoint(se3.inverse(T_odom_base)) @ whole
        return np.outer(displacement, displacement)
