"""Status of wheels and gyro."""

from __future__ import annotations

from collections.abc import Callable

from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, GYRO_OFFSET, TURN, WHEEL_OFFSET, MotionSensors
from omnid.stages.motion_inbox import MotionInbox
from omnid.stages.odometry import OdometryStage
from omnid.transport.codec import OK, WARN
from omnid.transport.records import DiagnosticStatus
from omnid.transport.sensor_receiver import SensorReceiver
from omnid.transport.status_names import MOTION, REFUSED_PREFIX

WRONG_WHEELS = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
SLIP = "wheels slip"


def motion_status(
    odometry: OdometryStage,
    inbox: MotionInbox,
    receiver: SensorReceiver | None = None,
) -> Callable[[], DiagnosticStatus]:
    """Return a function that returns the entry: samples, their estimated errors, and the sensor that differs."""
    sensors = odometry.sensors

    def status() -> DiagnosticStatus:
        values = {
            "wheel_samples": str(inbox.wheels),
            "gyro_samples": str(inbox.gyro),
            "dropped": str(inbox.dropped),
            "slips": str(sensors.slips),
            "refused_gyro": str(sensors.refused),
        }
        if sensors.steps:
            values |= _estimates(sensors, wheels=bool(inbox.wheels), gyro=bool(inbox.gyro))
        if receiver is not None:
            values |= {f"{REFUSED_PREFIX}{key}": str(count) for key, count in sorted(receiver.refused.items())}
        witness = odometry.witness
        text = f"{witness.reason} {witness.detail}".strip()
        if not sensors.wheels_are_sane or sensors.is_slipping:
            text = SLIP if sensors.wheels_are_sane else WRONG_WHEELS
        return DiagnosticStatus(MOTION, WARN if text else OK, text, values)

    return status


def _estimates(sensors: MotionSensors, *, wheels: bool, gyro: bool) -> dict[str, str]:
    names = [("wheel_scale", DISTANCE, 1.0), ("turn_scale", TURN, 1.0), ("wheel_offset_ms", WHEEL_OFFSET, 1e3)]
    of_gyro = [
        ("gyro_offset_ms", GYRO_OFFSET, 1e3),
        *((f"gyro_bias_{axis}_radps", BIAS.start + k, 1.0) for k, axis in enumerate("xyz")),
    ]
    chosen = (names if wheels else []) + (of_gyro if gyro else [])
    return {
        key: text
        for name, state, unit in chosen
        for key, text in (
            (name, f"{unit * sensors.values[state]:.5f}"),
            (f"{name}_sigma", f"{unit * sensors.sigmas[state]:.5f}"),
        )
    }
