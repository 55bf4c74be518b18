"""One error-state Kalman filter of the motion: pose, velocity, acceleration, and the errors of wheels and gyro.

    x = [v, a, s, e],    v <- v + dt a,    T <- T exp(v dt),    e <- Ad(exp(-v dt)) e + dt v_error

v and a (6 each) are those of Dang et al. 2012, eq. (10) and (11), of the rectified frame in its own axes; s (5) scales
and bias of wheels and gyro (motion_sensors.py); e (6) is the error of the pose [t; r], which is zero itself:
only its covariance is followed. Measurements are applied in the order of trust, each with a gate by its Mahalanobis
distance: the step of the cameras, which also sets the pose's covariance, then what wheels and gyro measured in it. One
that is refused is none. A frame in which the cameras find nothing is prediction, and the errors of scales and bias add
up along it by the covariance of e and s. Where nothing measures it, the velocity is unknown, and steady.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.motion_hypotheses import REACH_SIGMAS
from omnid.core.odometry.motion_sensors import (
    ACCELERATION_SIGMAS,
    AHEAD,
    BIAS,
    DISTANCE,
    TURN,
    YAW,
    MotionSensors,
    Twist,
    on_a_plane,
)
from omnid.core.odometry.pose_estimation import OUTLIER_SQUARED

Array = NDArray[np.float64]

VELOCITY, ACCELERATION, SENSORS, POSE, SIZE = slice(0, 6), slice(6, 12), slice(12, 17), slice(17, 23), 23
# Spectral density of the jerk for translation and rotation, (m/s^3)^2/Hz and (rad/s^3)^2/Hz, of a wheeled robot.
# Measured: with 0.67 and 1.5 times as much the odometry errs 0.98 to 1.01 times as much, but for one log at 1152 px
JERK_PSD = (10.0, 40.0)
START_SPEED_SIGMA = 1.0  # m/s and rad/s, of a motion that is not known yet
# Standard deviation of the velocity while nothing measures it, m/s and rad/s: indoor vehicles are seldom twice as fast.
UNKNOWN_SPEED_SIGMA = 0.5
SLOWING_S = 0.3  # time constant of the predicted velocity's decay meanwhile
MOST_SIGMA = np.repeat([1000.0, math.pi], 3)  # of a pose, m and rad: larger ones would leave no digits to differences
# Standard deviations of the errors of wheels and gyro at the start, and those of their random walks over one second.
# After many steps that do not agree the first are ten times as large, so that all is learned again.
START_SIGMA = np.array([0.05, 0.1, 0.02, 0.02, 0.02])
WALK_SIGMA = np.array([2e-4, 5e-4, 5e-5, 5e-5, 5e-5])
STATES_OF: dict[type[MotionSample], slice] = {WheelSample: slice(DISTANCE, BIAS.start), GyroSample: BIAS}
SANE_SCALE = (0.5, 2.0)  # Limits of the wheels' scales: beyond them their settings are wrong.
CAMERA_SIGMA = np.repeat([3e-4, 1e-4], 3)  # of the cameras' step, m and rad, in addition to its covariance
# Consecutive outliers of wheels that mean slip, because a single one may be a bump. They are counted, and not timed,
# because each step is another measurement. After the larger number the sensor counts as not calibrated.
SLIPPING, MOST_OUTLIERS = 2, 40


class MotionFilter:
    """The filter; without samples of wheels and gyro that of the paper.

    slips counts steps in which the wheels moved otherwise than the cameras; refused, those of the gyro. since_found_s
    and grown_m2 are the time, and the growth of the position's variance, since the cameras found a pose.
    """

    def __init__(self, jerk_psd: tuple[float, float] = JERK_PSD, T_base_rect: Array | None = None) -> None:
        """jerk_psd: spectral density of the jerk, for translation and rotation."""
        self.sensors = MotionSensors()
        self._to_base = np.eye(6) if T_base_rect is None else se3.adjoint(T_base_rect)
        self._psd = np.repeat(jerk_psd, 3)
        self._filter = KalmanFilter(dim_x=SIZE, dim_z=6)
        self._filter.H = np.eye(6, SIZE)
        self._filter.x = np.zeros((SIZE, 1))
        self._filter.x[SENSORS][[DISTANCE, TURN]] = 1.0
        self._filter.P = np.zeros((SIZE, SIZE))
        self._filter.P[SENSORS, SENSORS] = np.diag(START_SIGMA**2)
        self.slips = self.refused = self.steps = 0
        self._outliers: dict[type[MotionSample], int] = {WheelSample: 0, GyroSample: 0}
        self._disagreements = 0  # consecutive steps in which the turns of wheels and gyro differ
        self._before_sensing = self._filter.x, self._filter.P
        self.since_found_s = self.grown_m2 = 0.0
        self.reset()

    def reset(self) -> None:
        """Reset to standstill, with the uncertainty of what a robot can do."""
        self._filter.x[:12] = 0.0
        self._set_covariance(slice(0, 12), np.repeat([START_SPEED_SIGMA, ACCELERATION_SIGMAS[1]], 6) ** 2)
        self._last_step: tuple[Array, float] | None = None  # T_prev_curr that was accepted last, and its time
        self._is_unknown = False  # nothing measures the velocity

    @property
    def velocity(self) -> Array:
        """Velocity (6,) [m/s; rad/s]."""
        return np.array(self._filter.x[VELOCITY, 0])

    @property
    def velocity_covariance(self) -> Array:
        """Covariance (6, 6) of the velocity."""
        return np.array(self._filter.P[VELOCITY, VELOCITY])

    @property
    def pose_covariance(self) -> Array:
        """Covariance (6, 6) [t; r] of the pose, in its own axes."""
        return np.array(self._filter.P[POSE, POSE])

    @property
    def values(self) -> Array:
        """Scales of the wheels' distance and turn, and bias of the gyro [rad/s]: (5,)."""
        return np.array(self._filter.x[SENSORS, 0])

    @property
    def wheels_are_sane(self) -> bool:
        """False if the wheels' scales are so far from 1 that their settings must be wrong."""
        return bool(all(SANE_SCALE[0] < scale < SANE_SCALE[1] for scale in self.values[[DISTANCE, TURN]]))

    @property
    def is_slipping(self) -> bool:
        """True if the wheels slipped in the last steps that the cameras saw."""
        return self._outliers[WheelSample] >= SLIPPING

    def at_exposure(self, dt_s: float = 0.0) -> RigVelocity:
        """Return the velocity at the last frame, or at the one to which a step of dt_s was predicted.

        The state holds the mean velocity of the step: at its end, half a step later, it is v + dt/2 a.
        """
        F = np.hstack([np.eye(6), dt_s / 2 * np.eye(6)])
        return RigVelocity(F @ self._filter.x[:12, 0], F @ self._filter.P[:12, :12] @ F.T)

    @staticmethod
    def of_step(T_prev_curr: Array, dt_s: float) -> RigVelocity:
        """Return the velocity at either end of a single step, which changes by an acceleration that is not known."""
        return RigVelocity(se3.log(T_prev_curr) / dt_s, (ACCELERATION_SIGMAS[1] * dt_s / 2) ** 2 * np.eye(6))

    def predict(self, dt_s: float) -> Array:
        """Predict the state dt_s later and return the expected motion T_prev_curr (4, 4)."""
        F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
        if not self._is_unknown:
            v, a = np.arange(6), np.arange(6, 12)
            F[v, a] = dt_s
            Q[v, v] = self._psd * dt_s**3 / 3
            Q[v, a] = Q[a, v] = self._psd * dt_s**2 / 2
            Q[a, a] = self._psd * dt_s
        Q[SENSORS, SENSORS] = np.diag(WALK_SIGMA**2 * dt_s)
        self._filter.predict(F=F, Q=Q)
        return se3.exp(self.velocity * dt_s)

    def update(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> Array:
        """Update with a motion that the cameras measured, with its covariance (6, 6); return the filtered one (eq. 11).

        The measured velocity is the motion over its time.
        """
        self._filter.update(se3.log(T_prev_curr)[:, None] / dt_s, R=covariance / dt_s**2)
        self._symmetrise()
        return se3.exp(self.velocity * dt_s)

    def step(self, interval_s: tuple[float, float] | None, dt_s: float, most_s: float) -> tuple[Array, bool]:
        """Return the step T_prev_curr (4, 4) to a frame dt_s later, and whether wheels and gyro measured all of it.

        interval_s: start and end by the clock of the samples; None: there are none. most_s: the cameras' velocity holds
        for this time at most.
        """
        # 1. What wheels and gyro say is a measurement of the filter. Wheels whose turn differs from that of the gyro
        #    twice in a row slip, as those that the cameras contradict, and are left out.
        values, wheels, gyro = self.values, Twist(), Twist()
        if interval_s is not None and dt_s > 0:
            gyro = self.sensors.measured(GyroSample, interval_s, values)
            if self.wheels_are_sane and not self.is_slipping:
                wheels = self.sensors.measured(WheelSample, interval_s, values)
        differ = YAW in wheels and YAW in gyro and self._differ(wheels, gyro)
        self._disagreements = self._disagreements + 1 if differ else 0
        if self._disagreements >= SLIPPING:
            wheels = Twist()
            self.slips += 1
        twist = (on_a_plane(wheels, values) if wheels else wheels) | gyro
        is_complete = AHEAD in twist and YAW in twist
        # 2. The prediction; a velocity that was not known is learned from its start.
        if self._is_unknown and is_complete:
            self.reset()
        T_prev_curr = self.predict(min(dt_s, most_s))
        self._before_sensing = self._filter.x.copy(), self._filter.P.copy()
        for axis in twist:
            self._measure(twist, axis, values, dt_s)
        return se3.exp(self.velocity * dt_s) if twist else T_prev_curr, is_complete

    def accept(
        self, T_prev_curr: Array, covariance: Array, dt_s: float, interval_s: tuple[float, float] | None
    ) -> RigVelocity:
        """Update the filter with the step that the cameras found (eq. 11), with its covariance (6, 6).

        interval_s: as in `step`; the sensors are compared with the cameras in it. None: they are not. Returns the
        velocity at the pair before the step, from the steps around it. A velocity that changes evenly is exact there;
        how far it changes unevenly in a step, no step shows.
        """
        # 1. The cameras, and then the sensors, each if it agrees. A step that no acceleration explains, as by a jerk,
        #    does not tell how the motion goes on: as before, or as in the step.
        if interval_s is not None:
            self._filter.x, self._filter.P = self._before_sensing
        now, before, self._last_step = self.of_step(T_prev_curr, dt_s), self._last_step, (T_prev_curr, dt_s)
        change = now.twist - self.velocity
        squared = change @ np.linalg.solve(self.velocity_covariance + 4 * now.covariance, change)
        if squared < len(change) * REACH_SIGMAS**2:
            self.update(T_prev_curr, covariance, dt_s)
        else:
            self._filter.P[VELOCITY, VELOCITY] += np.outer(change, change)
        if interval_s is not None:
            self._compare(interval_s, dt_s)
        # 2. The velocity at the pair before.
        if before is None:
            return now
        before_rate, before_s = se3.log(before[0]) / before[1], before[1]
        at_previous = (before_s * now.twist + dt_s * before_rate) / (before_s + dt_s)
        uneven = np.diag(((now.twist - before_rate) / 2) ** 2)
        return RigVelocity(at_previous, covariance / (2 * dt_s**2) + uneven)

    def found(self, covariance: Array) -> None:
        """Set the covariance (6, 6) of a pose that the cameras have found."""
        if self._is_unknown:
            self.reset()
        self._filter.P[POSE] = self._filter.P[:, POSE] = 0.0
        self._filter.P[POSE, POSE] = covariance
        self.since_found_s = self.grown_m2 = 0.0

    def carry(self, dt_s: float, *, is_measured: bool) -> None:
        """Move the pose's covariance on by the last step, in which the cameras found no pose.

        is_measured: by wheels and gyro; else the velocity is not known.
        """
        self._last_step = None
        if not is_measured:
            self._forget_velocity()
        # e <- Ad(exp(-v dt)) e + dt v_error
        F = np.eye(SIZE)
        F[POSE, POSE] = se3.adjoint(se3.exp(-self.velocity * dt_s))
        F[POSE, VELOCITY] = dt_s * np.eye(6)
        moved = F @ self._filter.P @ F.T
        self.since_found_s += dt_s
        self.grown_m2 += float(np.diag(moved - self._filter.P)[POSE][:3].max())
        self._filter.P = bounded(moved, POSE)
        if not is_measured:
            self._filter.x[:12] *= math.exp(-dt_s / SLOWING_S)

    def distrust(self, covariance: Array) -> None:
        """Add a covariance (6, 6) to that of the pose, for a motion that nothing has measured; nor is the velocity."""
        self._filter.P[POSE, POSE] += covariance
        self.grown_m2 += float(np.diag(covariance)[:3].max())
        self._forget_velocity()

    def _forget_velocity(self) -> None:
        if not self._is_unknown:
            self._is_unknown = True
            self._set_covariance(slice(0, 12), np.repeat([UNKNOWN_SPEED_SIGMA**2, 0.0], 6))

    def _differ(self, wheels: Twist, gyro: Twist) -> bool:
        """True if wheels and gyro measure turns in a step that differ by more than their errors."""
        H = wheels[YAW].slopes - gyro[YAW].slopes
        variance = wheels[YAW].variance + gyro[YAW].variance + H @ self._filter.P[SENSORS, SENSORS] @ H
        return bool((wheels[YAW].value - gyro[YAW].value) ** 2 > OUTLIER_SQUARED * variance)

    def _compare(self, interval_s: tuple[float, float], dt_s: float) -> None:
        """Update with what the sensors measured in a step of the cameras, and count where they disagree with it."""
        self.steps += 1
        values = self.values
        for sensor in STATES_OF:
            twist = self.sensors.measured(sensor, interval_s, values)
            if not twist:
                continue
            ratios = [self._measure(twist, axis, values, dt_s, is_gated=True) for axis in twist]
            agrees = max(ratios) <= OUTLIER_SQUARED
            self.slips += sensor is WheelSample and not agrees
            self.refused += sensor is GyroSample and not agrees
            self._outliers[sensor] = 0 if agrees else self._outliers[sensor] + 1
            if self._outliers[sensor] > MOST_OUTLIERS:
                # Its settings may be wrong: they are learned again.
                self._outliers[sensor] = 0
                states = STATES_OF[sensor]
                self._set_covariance(slice(12 + states.start, 12 + states.stop), 100 * START_SIGMA[states] ** 2)

    def _measure(self, twist: Twist, axis: int, values: Array, dt_s: float, *, is_gated: bool = False) -> float:
        """Update with one component of the base's twist; return the squared Mahalanobis distance of its innovation.

        values: of the sensors' errors with which it was computed. With a gate, one beyond it is none, and the cameras
        have given the velocity: their error counts as well.
        """
        value, slopes, variance = twist[axis]
        H = np.zeros((1, SIZE))
        H[0, VELOCITY], H[0, SENSORS] = self._to_base[axis] * dt_s, -slopes
        R = variance + (CAMERA_SIGMA[axis] ** 2 if is_gated else 0.0)
        z = value - slopes @ values
        innovation = float(z - (H @ self._filter.x)[0, 0])
        ratio = innovation**2 / float((H @ self._filter.P @ H.T)[0, 0] + R)
        if not is_gated or ratio <= OUTLIER_SQUARED:
            self._filter.update(np.array([[z]]), R=np.array([[R]]), H=H)
            self._symmetrise()
        return ratio

    def _set_covariance(self, states: slice, variances: Array) -> None:
        """Set the variances of some states, which are then independent of all others."""
        self._filter.P[states] = self._filter.P[:, states] = 0.0
        self._filter.P[states, states] = np.diag(variances)

    def _symmetrise(self) -> None:
        """Rounding must not make the covariance unsymmetric, nor e anything but zero."""
        self._filter.P = (self._filter.P + self._filter.P.T) / 2
        self._filter.x[POSE] = 0.0


def bounded(covariance: Array, pose: slice = slice(None)) -> Array:
    """Return a covariance (N, N) in which the sigmas of a pose are MOST_SIGMA at most; its correlations stay."""
    share = np.ones(len(covariance))
    share[pose] = np.minimum(1.0, MOST_SIGMA / np.sqrt(np.maximum(np.diag(covariance)[pose], 1e-30)))
    return np.asarray(covariance * np.outer(share, share))
