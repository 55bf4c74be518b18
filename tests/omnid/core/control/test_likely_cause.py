"""Wrong settings of wheels and gyro are named by what they make of a drive, over generated accounts of it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.control.motion_monitor import Conflict, Motion, MotionMonitor, MotionSettings, Twist
from omnid.core.odometry.motion_agreement import MotionAgreement
from omnid.core.odometry.motion_filter import MotionFilter

START_NS = 10**12
HALF_TRACK_M = 0.15
Path = Callable[[float], tuple[float, float]]  # velocity [m/s] and yaw rate [rad/s] at a time
Wheels = Callable[[float, float], tuple[float, float]]
Gyro = Callable[[float], float]


def curves(time_s: float) -> tuple[float, float]:
    return 0.3, 0.4 * math.sin(0.7 * time_s)


def arc(_: float) -> tuple[float, float]:
    return 0.3, 0.5


def straight(_: float) -> tuple[float, float]:
    return 0.3, 0.0


def left_reversed(v: float, w: float) -> tuple[float, float]:
    return HALF_TRACK_M * w, v / HALF_TRACK_M


def right_reversed(v: float, w: float) -> tuple[float, float]:
    return -HALF_TRACK_M * w, -v / HALF_TRACK_M


def right_wheels(v: float, w: float) -> tuple[float, float]:
    return v, w


def right_gyro(w: float) -> float:
    return w


def conflict(
    path: Path, wheels: Wheels | None, gyro: Gyro | None, seconds: float = 4.0, late_s: float = 0.0
) -> Conflict:
    """Return what the comparison says after so many seconds; late_s: of the images."""
    motion, rng = MotionFilter(), np.random.default_rng(1)
    sensors, agreement = motion.sensors, MotionAgreement(motion)
    for step in range(1, round(seconds * 10)):
        samples: list[MotionSample] = []
        for sample_s in np.arange(step / 10 - 0.1, step / 10, 0.02):
            v, w = path(float(sample_s))
            at_ns = START_NS + round(sample_s * 1e9)
            samples += [WheelSample(at_ns, *wheels(v, w))] if wheels else []
            samples += [GyroSample(at_ns, 0.0, 0.0, gyro(w))] if gyro else []
        sensors.add(samples)
        v, w = path(step / 10 - 0.05 - late_s)
        seen = (0.1 * np.array([v, w]) + rng.normal(0.0, 2e-4, 2)).tolist()
        agreement.add_step(START_NS + step * 10**8 - 10**8, START_NS + step * 10**8, *seen)
    return agreement.result


@pytest.mark.parametrize(
    ("path", "wheels", "gyro", "expected"),
    [
        *[
            (path, wheels, gyro, words)
            for path in (curves, arc)
            for wheels in (None, right_wheels)
            for gyro, words in (
                (math.degrees, "the gyro turns 57 times as far as the images: deg/s?"),
                (lambda w: -math.degrees(w), "the gyro turns the other way, 57 times as far: sign"),
                (lambda w: -w, "the gyro turns the other way: sign, or mirrored images"),
                (lambda w: 2.0 * w, "the gyro turns 2 times as far as the images"),
                (math.radians, "the gyro turns 0.017 times as far as the images: is it in rad/s"),
            )
        ],
        *[
            (path, lambda v, w, k=k: (k * v, k * w), gyro, f"the wheels drive {k:.2g} times as far as the images")
            for path in (curves, arc, straight)
            for gyro in (None, right_gyro)
            for k in (3.0, 0.33)
        ],
        *[(path, lambda v, w: (v, -w), right_gyro, "motor.drive.swapped") for path in (curves, arc)],
        *[(path, left_reversed, right_gyro, "motor.drive.reverse_left, or") for path in (curves, arc, straight)],
        *[(path, right_reversed, None, "motor.drive.reverse_right, or") for path in (curves, arc, straight)],
        *[(path, lambda v, w: (-v, -w), None, "motor.drive.reverse_left and") for path in (curves, arc, straight)],
        (
            curves,
            lambda v, w: (v, w / 2),
            right_gyro,
            "the wheels turn 0.5 times as far as the images: motor.drive.track_m",
        ),
        (curves, lambda v, w: (v, -w), lambda w: -w, "the images turn the other way: are they mirrored?"),
        # The first tenth of a second of a turn, after which the base is stopped.
        (lambda t: (0.3, 0.6 if t > 3.79 else 0.0), right_wheels, math.degrees, "times as far as the images: deg/s?"),
        # Wheels that turn as commanded, whatever the base does: driven straight on, it turns on the spot.
        (lambda _: (0.0, 2.0), lambda v, w: (0.3, 0.0), right_gyro, "motor.drive.reverse_left, or"),
    ],
)
def test_a_wrong_setting_is_named(path: Path, wheels: Wheels | None, gyro: Gyro | None, expected: str) -> None:
    found = conflict(path, wheels, gyro)
    assert found.reason and expected in found.detail, found


@pytest.mark.parametrize("late_s", [0.0, 0.8])
def test_nothing_is_guessed_of_right_settings(late_s: float) -> None:
    found = conflict(curves, right_wheels, right_gyro, 9.0, late_s)
    assert ":" not in found.detail and bool(found.reason) == bool(late_s)


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        ((0.0, 2.0), "the left wheel turns the other way: motor.drive.reverse_left"),
        ((0.0, -2.0), "the right wheel turns the other way: motor.drive.reverse_right"),
        ((-0.3, 0.0), "the wheels drive the other way"),
        ((0.9, 0.0), "the wheels drive 0.33 times as far as the images"),
        ((0.0, 0.0), "commanded +0.30 m/s +0.00 rad/s, seen +0.00 m/s +0.00 rad/s)"),
    ],
)
def test_what_was_commanded_and_seen_is_named_when_the_base_stops(seen: tuple[float, float], expected: str) -> None:
    monitor = MotionMonitor(MotionSettings())
    for tick in range(60):
        now_ns = START_NS + tick * 50_000_000
        monitor.add_command(now_ns, Twist(0.3, 0.0))
        if tick % 2:
            monitor.add_seen(now_ns, Motion(*seen))
    assert monitor.reason and expected in monitor.detail
