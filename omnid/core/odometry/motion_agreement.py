"""Do images, wheels and gyro show the same motion at the same time? Slow disagreement, over metres and seconds.

Images that come late, play slowly, or are of a rig of another size track well, and so do wheels of another radius: each
of them is consistent in itself. Three accounts of the same drive are not:

    distance  of images and wheels
    turn      of images, wheels and gyro, each with each

1. Delay. For lags l from -0.5 to 1.5 s, J(l) = min_s sum (s D(start - l, end - l) - seen)^2 over the steps of the last
   10 s, D the motion by a sensor. The smallest J(l) is compared with the smallest one within 0.3 s of 0: their
   difference in variances of the residuals is the evidence (a likelihood ratio). A steady motion has none.
2. Scale. The sums of both over the newest 3 m or 10 s, whichever is shorter, at the likeliest lag within 0.3 s.
3. Direction. Wheels roll forwards: motion to the side, as the images show it while the base drives straight on, is that
   of a rig whose yaw on the base is not that of T_base_rig.

The account that two others contradict, which agree, is named; of two it is not known which one is wrong. A
part of a limit is a doubt. Once all have been at rest for STILL_S everything is forgotten: a person may arm and try
again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, WheelSample
from omnid.core.control import likely_cause
from omnid.core.control.likely_cause import Steps
from omnid.core.control.motion_monitor import (
    AGREE,
    GYRO_DIFFERS,
    IMAGES_ASIDE,
    IMAGES_DIFFER,
    IMAGES_OR_GYRO,
    IMAGES_OR_WHEELS,
    WHEELS_DIFFER,
    Difference,
    Witness,
)
from omnid.core.odometry.motion_filter import MotionFilter

Array = NDArray[np.float64]
_Motion = Callable[[Array, Array], Array]  # of a sensor, from starts to ends [s]; NaN where no samples cover it

# So much because a delay of 0.3 s is 0.15 m at 0.5 m/s, what the collision monitor keeps as distance; 10 % of 3 m is
# twice that.
WINDOW_S, WINDOW_M, SCALE_SHARE, ALLOWED_LAG_S = 10.0, 3.0, 0.1, 0.3
# Lags that are compared: buffers of cameras hold up to a second or so, because drivers keep a handful of images.
LEAST_LAG_S, MOST_LAG_S, LAG_STEP_S = -0.5, 1.5, 0.05
# Sigma of a lag that is in order, because motors follow commands late and exposures last: of two accounts one may show
# a motion so much before the other.
LAG_SIGMA_S: Final = 0.1
DOUBT_SHARE: Final = 0.5  # Share of a limit from which on the base drives slowly; by trial on development seeds.
# The same of the newest second alone: 0.1 m, and a third of the way, because images that play at half of the speed show
# half of it.
SOON_S, SOON_M, SOON_SHARE = 1.0, 0.1, 1 / 3
# Motion to the side as a share of the way: 0.15 m a metre ahead, because the collision monitor keeps as much as
# distance.
ASIDE_SHARE: Final = 0.15
STRAIGHT_RADPM: Final = 0.1  # Most turn of a straight way, because in a curve an offset of the rig moves to the side.
LEAST_M: Final = 0.05  # Least motion that counts, because an allowed delay moves a base of 0.2 m/s so far.
TURN_RAD: Final = np.radians(5.0)  # because a gyro's bias is estimated to less than half a degree a second
# More than 4 degrees, because wheels whose diameters differ by 0.7 %, as those of the simulation, turn by so much over
# 3 m, which is no doubt yet.
WHEEL_TURN_RAD: Final = np.radians(15.0)
# Sigmas of a step that are added to those of its residuals: roughness of floor and images; by trial on development
# seeds.
STEP_M, STEP_RAD = 0.003, 0.003
EVIDENCE: Final = 50.0  # Log-likelihood ratio, doubled: seven sigma, because a lag is sought in each pair.
WORSE: Final = 3.0  # ratio of the sums of squares that the lag must explain, because slip makes both of them large
LATE_S: Final = 0.5  # A lag is a fault after this time, because the newest steps are the most noisy.
SCALES: Final = (0.3, 3.0)  # Scales of the motion in the search of a lag, because images may be slow as well as late.
STILL_S, STILL_M, STILL_RAD = 2.0, 0.02, 0.04  # Limits of rest, because 1 cm/s and a degree a second are noise.
MOST_KEPT: Final = 2048  # steps, so that memory is bounded: WINDOW_S at 200 Hz
LEAST_STEP_S: Final = 0.01  # Least time of a step by which its speed is known.
LEAST_STEPS: Final = 8  # Steps that are needed for a comparison, because fewer show no delay.
EVERY_S: Final = 0.1  # Time between two comparisons, because each takes a millisecond.


class _Steps(NamedTuple):
    """Motion of the base from pair to pair by the cameras, from the oldest to the newest: arrays (N,)."""

    starts_s: Array
    ends_s: Array
    ways_m: Array
    turns_rad: Array
    aside_m: Array

    @property
    def is_long(self) -> bool:
        """True if they fill the window of time."""
        return bool(self.ends_s[-1] - self.starts_s[0] >= WINDOW_S - LEAST_STEPS * EVERY_S)


class _Finding(NamedTuple):
    """Comparison of one account with the images, or of wheels with the gyro."""

    lag_s: float = 0.0  # delay of the images; beyond the allowed ones where there is evidence
    excess: float = 0.0  # difference of the sums in parts of its limit; 1 and more is a fault
    text: str = ""
    difference: Difference = Difference()  # empty where the images are late

    @property
    def is_late(self) -> bool:
        """True if the images are late by more than is allowed."""
        return abs(self.lag_s) > ALLOWED_LAG_S

    @property
    def differs(self) -> bool:
        """True if it is at least a doubt."""
        return self.is_late or self.excess >= DOUBT_SHARE


class MotionAgreement:
    """Follows the accounts; memory and work are bounded."""

    def __init__(self, motion: MotionFilter) -> None:
        """motion: the filter, with the samples of wheels and gyro."""
        self._steps: deque[tuple[float, float, float, float, float]] = deque(maxlen=MOST_KEPT)  # see _Steps
        self._motion = motion
        self._lags_s = np.arange(LEAST_LAG_S, MOST_LAG_S + LAG_STEP_S / 2, LAG_STEP_S)
        self._compared_s = -np.inf
        self._late_since_s: float | None = None
        self.result = AGREE

    def _wheels_m(self, starts_s: Array, ends_s: Array) -> Array:
        return self._motion.motion(WheelSample, starts_s, ends_s)[..., 0]

    def _wheels_rad(self, starts_s: Array, ends_s: Array) -> Array:
        return self._motion.motion(WheelSample, starts_s, ends_s)[..., 1]

    def _gyro_rad(self, starts_s: Array, ends_s: Array) -> Array:
        return self._motion.motion(GyroSample, starts_s, ends_s)[..., 2]

    def add_step(self, start_ns: int, end_ns: int, distance_m: float, turn_rad: float, aside_m: float = 0.0) -> None:
        """Add the motion of the base from one pair to the next, as the cameras saw it; compare.

        aside_m: along its y axis.
        """
        end_s = self._motion.sensors.seconds(end_ns)
        self._steps.append((self._motion.sensors.seconds(start_ns), end_s, distance_m, turn_rad, aside_m))
        self._forget_before(end_s - WINDOW_S)
        if end_s - self._compared_s < EVERY_S:
            return
        self._compared_s = end_s
        steps = _Steps(*np.array(self._steps).T)
        if self._is_at_rest(steps):
            self._forget_before(end_s - STILL_S)
            self._late_since_s, self.result = None, AGREE
        elif len(self._steps) >= LEAST_STEPS:
            self.result = self._compare(steps)

    def _forget_before(self, time_s: float) -> None:
        while self._steps and self._steps[0][1] < time_s:
            self._steps.popleft()

    def _compare(self, steps: _Steps) -> Witness:
        """Return the account that differs, and whether it is a fault."""
        distance = self._finding(steps, steps.ways_m, self._wheels_m, STEP_M, LEAST_M)
        of_wheels = self._finding(steps, steps.turns_rad, self._wheels_rad, STEP_RAD, WHEEL_TURN_RAD)
        of_gyro = self._finding(steps, steps.turns_rad, self._gyro_rad, STEP_RAD, TURN_RAD)
        # The larger one of distance and turn of the wheels; a lag counts as a fault.
        wheels = max((distance, of_wheels), key=lambda found: (found.differs, found.excess, abs(found.lag_s)))
        if not wheels.differs and not of_gyro.differs:
            self._late_since_s = None
            aside = _UNKNOWN if distance is _UNKNOWN else self._aside(steps)
            return Witness(IMAGES_ASIDE, aside.text, aside.excess >= 1.0) if aside.differs else AGREE
        if wheels.differs and of_gyro.differs:
            reason, found = IMAGES_DIFFER, max(wheels, of_gyro, key=lambda found: found.excess)
        elif wheels.differs:
            # The gyro knows nothing of distances.
            reason = WHEELS_DIFFER if of_wheels.differs and of_gyro is not _UNKNOWN else IMAGES_OR_WHEELS
            found = wheels
        else:
            by_gyro = self._gyro_rad(steps.starts_s, steps.ends_s)
            between = self._finding(steps, by_gyro, self._wheels_rad, STEP_RAD, WHEEL_TURN_RAD)
            is_alone = of_wheels is not _UNKNOWN and between.excess >= of_wheels.excess
            reason, found = GYRO_DIFFERS if is_alone else IMAGES_OR_GYRO, of_gyro
        now_s = float(steps.ends_s[-1])
        self._late_since_s = (self._late_since_s or now_s) if found.is_late else None
        is_long = self._late_since_s is not None and now_s - self._late_since_s >= LATE_S
        # Wheels that turn otherwise than images and gyro are explained by themselves: a weak motor, another radius. The
        # pose is right, so the base drives on slowly. Their distance, and a delay, nobody else confirms.
        is_explained = reason == WHEELS_DIFFER and not found.is_late and distance.excess < 1.0
        is_fault = bool(is_long or (found.excess >= 1.0 and not is_explained))
        turn = of_gyro if of_gyro.differs else of_wheels
        differences = (each.difference if each.differs else Difference() for each in (distance, turn))
        cause = self._cause(reason, steps)
        detail = f"{'by a factor' if cause and found.is_late else found.text}{cause and ': '}{cause}"
        return Witness(reason, detail, is_fault, *differences)

    def _cause(self, reason: str, steps: _Steps) -> str:
        """Return what makes the accounts differ as they do; empty where that is not known."""
        ways, turns, gyro = (
            motion(steps.starts_s, steps.ends_s).tolist()
            for motion in (self._wheels_m, self._wheels_rad, self._gyro_rad)
        )
        seen = Steps(steps.ways_m.tolist(), steps.turns_rad.tolist())
        if reason == IMAGES_DIFFER:
            return likely_cause.of_images(seen.turns, gyro)
        if reason in (GYRO_DIFFERS, IMAGES_OR_GYRO):
            return likely_cause.of_gyro(seen.turns, gyro)
        return likely_cause.of_wheels(seen, Steps(ways, turns))

    def _finding(self, steps: _Steps, seen: Array, motion: _Motion, noise: float, least: float) -> _Finding:
        """Compare the motion seen (N,) in steps with that of a sensor, both in metres or radians.

        noise: standard deviation of a step; least: difference of the sums that is a fault.
        """
        by_lag = motion(steps.starts_s - self._lags_s[:, None], steps.ends_s - self._lags_s[:, None])
        near = int(np.argmin(np.abs(self._lags_s)))
        # 1. Delay; the newest steps have no samples of later times yet.
        known = np.isfinite(by_lag).all(axis=0) & np.isfinite(seen)
        if known.sum() >= LEAST_STEPS:
            best, near, is_late = self._lag(by_lag[:, known], seen[known], noise)
            if is_late:
                lag_s = float(self._lags_s[best])
                return _Finding(lag_s, 0.0, f"by {abs(lag_s):.1f} s")
        # 2. Scale, at the likeliest of the allowed lags.
        return self._scale(steps, seen, by_lag[near], least)

    @staticmethod
    def _scale(steps: _Steps, seen: Array, moved: Array, least: float) -> _Finding:
        """Compare the sums of the motion seen (N,) and of that of a sensor (N,), over the newest WINDOW_M."""
        is_distance = seen is steps.ways_m
        known = np.isfinite(moved) & np.isfinite(seen)
        if known.sum() < LEAST_STEPS:
            return _UNKNOWN
        # 1. Both sums, of the newest steps.
        newest = np.flatnonzero(known)[::-1]
        moved, seen, ends_s = moved[newest], seen[newest], steps.ends_s[newest]
        times_s = ends_s - steps.starts_s[newest]
        path = np.cumsum(np.abs(moved))
        along = path if is_distance else np.cumsum(np.abs(steps.ways_m[newest]))
        count = int(np.searchsorted(along, WINDOW_M)) + 1
        length, apart = float(path[:count][-1]), float((moved[:count] - seen[:count]).sum())
        difference = Difference(apart, float(times_s[:count].sum()))
        # 2. The limit: a share of the way, and the motion within the lag that is in order.
        is_whole = count <= len(path) or steps.is_long or not is_distance
        limit = max(SCALE_SHARE * (length if is_whole else WINDOW_M), least)
        limit += LAG_SIGMA_S * float((np.abs(seen) / np.maximum(times_s, LEAST_STEP_S)).max())
        # 3. Of a distance the newest second alone as well, which may show a doubt sooner.
        if is_distance:
            soon = int(np.searchsorted(steps.ends_s[-1] - ends_s, SOON_S))
            lacking = abs(float((moved[:soon] - seen[:soon]).sum()))
            if lacking > max(SOON_M, SOON_SHARE * float(np.abs(moved[:soon]).sum())) and abs(apart) < limit:
                text = f"by {lacking:.2f} m in {SOON_S:.0f} s"
                return _Finding(0.0, max(DOUBT_SHARE, abs(apart) / limit), text, difference)
        shown = f"{abs(apart):.2f} m in {length:.1f} m" if is_distance else f"{np.degrees(abs(apart)):.0f} degrees"
        return _Finding(0.0, abs(apart) / limit, f"by {shown}", difference)

    @staticmethod
    def _aside(steps: _Steps) -> _Finding:
        """Return the motion to the side (N,) in the straight part of the newest WINDOW_M."""
        ways, aside = steps.ways_m, steps.aside_m
        straight = (np.abs(steps.turns_rad) <= STRAIGHT_RADPM * np.abs(ways)) & (np.abs(aside) < np.abs(ways))
        path_m = np.cumsum(np.abs(ways[straight][::-1]))
        count = min(len(path_m), int(np.searchsorted(path_m, WINDOW_M)) + 1)
        if count < LEAST_STEPS:
            return _UNKNOWN
        moved_m, length_m = abs(float((aside * np.sign(ways))[straight][::-1][:count].sum())), float(path_m[count - 1])
        is_whole = count < len(path_m) or steps.is_long
        limit_m = max(ASIDE_SHARE * (length_m if is_whole else WINDOW_M), LEAST_M)
        return _Finding(0.0, moved_m / limit_m, f"by {np.degrees(np.arctan2(moved_m, length_m)):.0f} degrees")

    def _lag(self, by_lag: Array, seen: Array, noise: float) -> tuple[int, int, bool]:
        """Return the best lag, the best one that is allowed, and whether the evidence for the other is strong."""
        power = (by_lag**2).sum(axis=1)
        scale = np.clip((by_lag @ seen) / np.maximum(power, 1e-12), *SCALES)
        squares = ((scale[:, None] * by_lag - seen) ** 2).sum(axis=1)
        is_allowed = np.abs(self._lags_s) <= ALLOWED_LAG_S + LAG_STEP_S / 2
        best = int(np.argmin(squares))
        variance = squares[best] / len(seen) + noise**2
        # Of a steady motion any lag is as good: without evidence it is near 0.
        likely = squares + variance * (self._lags_s / LAG_SIGMA_S) ** 2
        near = int(np.flatnonzero(is_allowed)[np.argmin(likely[is_allowed])])
        is_strong = squares[near] - squares[best] > EVIDENCE * variance and squares[near] > WORSE * squares[best]
        return best, near, bool(is_strong and not is_allowed[best])

    def _is_at_rest(self, steps: _Steps) -> bool:
        """True if images and wheels have shown no motion for STILL_S."""
        now_s = float(steps.ends_s[-1])
        if steps.starts_s[0] > now_s - STILL_S:
            return False
        newest = steps.ends_s > now_s - STILL_S
        starts_s, ends_s = np.array([now_s - STILL_S]), np.array([now_s - LAG_STEP_S])
        ways_m = (steps.ways_m[newest].sum(), *self._wheels_m(starts_s, ends_s))
        turns_rad = (steps.turns_rad[newest].sum(), *self._wheels_rad(starts_s, ends_s))
        # Wheels that say nothing (NaN) have not moved.
        return not any(abs(way) > STILL_M for way in ways_m) and not any(abs(turn) > STILL_RAD for turn in turns_rad)


_UNKNOWN: Final = _Finding()


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Displacements (6,) [t; r] [m; rad] from a pose by the images to the one by the other accounts, in its axes.

    What they differed by in a fault stays when they agree again, since a later image does not mend a pose that went
    wrong. A doubt is over with its reason.
    """

    T_odom_base: Array  # (4, 4) the pose by the images
    faults: Array
    doubt: Array
    fault_s: float  # time of the last fault

    def covariance(self) -> Array:
        """Return what it adds to the covariance (6, 6) of the pose, in its axes."""
        displacement = self.faults + self.doubt
        return np.outer(displacement, displacement)


def contradiction_after(
    before: Contradiction | None, witness: Witness, T_odom_base: Array, time_s: float
) -> Contradiction | None:
    """Return the contradiction at a pose: that of before, with what the accounts differ by since then."""
    if before is None and not witness.contradicts_images:
        return None
    faults, fault_s, doubt = np.zeros(6), -math.inf, np.zeros(6)
    if before is not None:
        moved = se3.adjoint(se3.inverse(T_odom_base) @ before.T_odom_base)
        faults, fault_s = moved @ before.faults, before.fault_s
    if witness.contradicts_images and witness.is_fault:
        # The sums of the witness overlap from pair to pair: only their part since the last fault is new.
        faults, fault_s = faults + _displacement(witness, time_s - fault_s), time_s
    elif witness.contradicts_images:
        doubt = _displacement(witness, time_s - fault_s)
    return Contradiction(T_odom_base, faults, doubt, fault_s)


def _displacement(witness: Witness, seconds: float) -> Array:
    """Return how much farther the base is by the others (6,), by the newest so many seconds.

    Ways and turns in them are so short that their order does not matter.
    """
    return np.array([witness.distance.part(seconds), 0.0, 0.0, 0.0, 0.0, witness.turn.part(seconds)])
