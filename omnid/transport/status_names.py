"""Names of the entries of `<robot>/status` and of their keys; producers and consumers take them from here.

Every number is a value of its own, written as a decimal number. Messages of entries are for people: programs do not
parse them, and they hold no number that changes from one report to the next.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from omnid.core.control.safety_rules import ASKED
from omnid.tracking_state import TrackingState
from omnid.transport.codec import DiagnosticStatus, decode_diagnostics

PREFIX: Final = "omnid: "
ODOMETRY: Final = f"{PREFIX}odometry"
PAIRING: Final = f"{PREFIX}pairing"
WHEELS: Final = f"{PREFIX}wheels"
BUS: Final = f"{PREFIX}bus"
CLOCK: Final = f"{PREFIX}clock"  # of the computer, whose steps the stamps follow
SAME_NAME_COUNT: Final = "same_name"  # value of the entry of the bus: other robots of this name
RECORDING: Final = f"{PREFIX}recording"
RIG: Final = f"{PREFIX}rig"
MOTION: Final = f"{PREFIX}wheels and gyro"  # in addition to the cameras
PLACES: Final = f"{PREFIX}places"
MAP_FILE: Final = f"{PREFIX}map file"
NAVIGATION: Final = f"{PREFIX}navigation"
REQUESTS: Final = f"{PREFIX}requests"  # to the navigation
IMAGES: Final = f"{PREFIX}images"  # parts of them that are frozen or blind
FLOOR: Final = f"{PREFIX}floor"  # height of the cameras above it
EXPOSURE: Final = f"{PREFIX}exposure"
CALIBRATION: Final = f"{PREFIX}calibration"  # of `omnid calibrate live`
SIMULATION: Final = f"{PREFIX}simulation"  # of a simulated robot whose time waits for the daemon
SUMMARY: Final = f"{PREFIX}summary"  # at the end of a replay
STAGE_PREFIX: Final = f"{PREFIX}stage "

STOPPED_PREFIX: Final = "stopped, "  # begins the keys that count stops of the wheels, by reason
REFUSED_PREFIX: Final = "refused, "  # begins the keys that count commands that are not valid, by reason
IGNORED_PREFIX: Final = "ignored, "  # begins the keys that count valid commands that may not drive, by reason

DISARMED_BY_STOP: Final = ASKED  # the value of disarmed_by after a stop

RUN_ID: Final = secrets.token_hex(4)  # of this program: one that starts again has another, and another odom

_TIME_SUFFIX: Final = "_ms"


FIXED_PERCENT: Final = "fixed_percent"  # of the panoramas, which shows what is fixed to a camera


class Key(StrEnum):
    """Keys that several entries have, or that omnid's own programs read."""

    # Odometry. An entry with `state` is published when the state changes and has the stamp of that pose.
    STATE = "state"
    RUN = "run"  # identity of the daemon's run, of its odom: RUN_ID
    RESETS = "resets"
    INLIERS = "inliers"  # landmarks that agree with the pose
    TRACKED = "tracked"  # landmarks found in the images
    LENGTH_M = "length_m"
    AGE_S = "age_s"  # of the newest pose or image
    RATE_HZ = "rate_hz"
    # Stages
    PROCESSED = "processed"
    DROPPED = "dropped"  # messages
    MISSED = "missed"  # deadlines of a ticker
    # Cameras and pairing
    DROPS = "drops"
    ERRORS = "errors"
    LOSSES = "losses"
    RESTARTS = "restarts"
    BROKEN = "broken"
    UNPAIRED_LOWER = "unpaired_lower"
    UNPAIRED_UPPER = "unpaired_upper"
    # Calibration
    PAIRS = "pairs"  # that are kept
    NEEDED = "needed"  # pairs
    MISSING = "missing"  # in words; no key where there is enough
    LOWER_COVERAGE = "lower_coverage"  # views from the hub to the rim, 12 clockwise digits a ring, 9: nine or more
    UPPER_COVERAGE = "upper_coverage"
    # Floor
    HEIGHT_M = "height_m"  # of the lower viewpoint
    SIGMA_M = "sigma_m"
    TILT_DEG = "tilt_deg"
    # Wheels
    EXPIRIES = "expiries"
    MEASURED = "measured"  # of commands, wheels, gyro and images that differ; no key while they agree
    PROBLEM = "problem"  # why the motor controller took no command; no key while it does
    COMMANDS = "commands"
    STOPS = "stops"
    SOURCE = "source"  # of the commands that drive; no key while none does
    ARMED = "armed"  # 1 or 0
    DISARMED_BY = "disarmed_by"  # the reason, no key while armed; DISARMED_BY_STOP after a stop
    REMEDY = "remedy"  # the way to arm, or past an obstacle; no key where none is needed
    OBSTACLE = "obstacle"  # why the collision monitor slows down or stops the base; no key while it does not
    OBSTACLE_STOPS = "obstacle_stops"
    COMMAND_REFUSAL = "command_refusal"  # why the newest refused command was refused; no key before the first one
    ARM_REFUSAL = "arm_refusal"  # of the newest request to arm; no key where it was accepted
    # Simulation
    REAL_TIME_FACTOR = "real_time_factor"  # simulated time over time on the wall
    # Map file
    SAVES = "saves"
    # Navigation, on its own topic
    TASK = "task"  # such as "goal" or "route NAME"; no key without one
    REASON = "reason"  # of a halt or an end
    COMMAND_NS = "command_ns"  # stamp of the request that the task follows from; no key without one
    LEFT_M = "left_m"  # way to the end of the path
    OFFSET_M = "offset_m"  # of the base to the left of the path
    LOOPS_LEFT = "loops_left"  # of a route, with the one that is driven
    TEACHING = "teaching"  # name of the route that is recorded
    TAUGHT_M = "taught_m"
    REQUEST = "request"  # the newest one, in a word
    REFUSAL = "refusal"  # why it is refused; no key where it was accepted


# Names of measured times: a time `work` has the keys work_p50_ms, work_p99_ms and work_max_ms.
WORK: Final = "work"
CAPTURE_TO_POSE: Final = "capture_to_pose"
CAPTURE_TO_WHEEL: Final = "capture_to_wheel"
TICK_LATE: Final = "tick_late"


# The usual advice for each part that can warn; an entry with a remedy of its own keeps that.
REMEDIES: Final = {
    ODOMETRY: "stop, then drive back slowly to a place that it has seen; check light and mirrors",
    PAIRING: "on the robot: omnid doctor",
    WHEELS: "remove the cause, then arm; on the robot: omnid doctor",
    BUS: "see bus.robot and bus.connect in the robot's configuration",
    RECORDING: "make room on the disk, or change record.folder",
    EXPOSURE: "switch lights on, or set cameras.exposure_limit_ms",
    FLOOR: "state the height of the cameras in the rig: omnid calibrate drive --only height",
    IMAGES: "clean the mirrors, look for glare and darkness, check the cameras and their driver",
    RIG: "omnid calibrate drive --only check on a recording; name the right rig.toml, or calibrate again",
    MOTION: "check motor.drive in the configuration, and the grip of the wheels",
    MAP_FILE: "make room on the disk, or change places.map",
    NAVIGATION: "remove the cause that the robot names, then `omnid goto` or `omnid route repeat` again",
    REQUESTS: "see the robot's log for the reason",
    PLACES: "drive slowly to where the map was made; where everything has changed, make a new map",
}
_CAMERA_REMEDY: Final = "check its cable and its power; on the robot: omnid doctor"


def camera_name(camera: str) -> str:
    """Return the name of a camera's entry."""
    return f"{PREFIX}{camera} camera"


def lost_parts_key(camera: str) -> str:
    """Return the key of the time for which a part of a camera's image has been frozen or blind."""
    return f"{camera}_since_s"


def stage_name(stage: str) -> str:
    """Return the name of a stage's entry."""
    return f"{STAGE_PREFIX}{stage}"


def short_name(name: str) -> str:
    """Return the name of an entry without the daemon's."""
    return name.removeprefix(PREFIX)


def with_remedy(status: DiagnosticStatus) -> DiagnosticStatus:
    """Return a status with the usual advice for its part, where it is not good and has no advice of its own."""
    usual = _CAMERA_REMEDY if status.name.endswith(" camera") else REMEDIES.get(status.name, "")
    if status.level == 0 or status.values.get(Key.REMEDY) or not usual:
        return status
    return replace(status, values={**status.values, Key.REMEDY: usual})


def time_key(name: str, statistic: str) -> str:
    """Return the key of a measured time in ms: time_key("work", "p50") == "work_p50_ms"."""
    return f"{name}_{statistic}{_TIME_SUFFIX}"


def parsed_time_key(key: str) -> tuple[str, str]:
    """Return name and statistic of the key of a measured time, ("work", "p50"); ("", "") for any other key."""
    name, _, statistic = key.removesuffix(_TIME_SUFFIX).rpartition("_")
    return (name, statistic) if name and key.endswith(_TIME_SUFFIX) else ("", "")


def number(text: str) -> float | None:
    """Return a value as a finite number; None for any other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def count(text: str) -> int | None:
    """Return a value as a count; None for any other text."""
    value = number(text)
    return int(value) if value is not None and value >= 0 and value.is_integer() else None


def tracking_state(message: str, values: Mapping[str, str]) -> TrackingState | None:
    """Return the tracking state in an entry of the odometry: its key `state`, else its message; None without one."""
    text = values.get(Key.STATE, message)
    return TrackingState(text) if text in list(TrackingState) else None


@dataclass(frozen=True, slots=True)
class NavigationReport:
    """State of goals, paths and routes; see omnid.navigation_state for the states."""

    stamp_ns: int
    state: str
    reason: str  # of a halt or an end
    task: str  # "goal", "path" or "route NAME"
    command_ns: int  # stamp of the goal or path that it follows from; 0 without
    left_m: float  # way to the end; NaN unknown
    request: str  # the newest one
    refusal: str  # empty where it was accepted
    teaching: str = ""  # name of the route that is recorded
    taught_m: float = 0.0


def decode_navigation(payload: bytes, _: bytes = b"") -> NavigationReport:
    """Decode the state of the navigation. Raise OmnidError for any other bytes."""
    report = decode_diagnostics(payload)
    keys = (Key.STATE, Key.REASON, Key.TASK, Key.COMMAND_NS, Key.LEFT_M, Key.REQUEST, Key.REFUSAL, Key.TEACHING)
    state, reason, task, command, left, request, refusal, teaching = (report.value(NAVIGATION, key) for key in keys)
    # A stamp has at most 19 digits, which a float does not hold.
    command_ns = int(command) if command.isascii() and command.isdigit() and len(command) < 20 else 0
    left_m, taught_m = number(left), number(report.value(NAVIGATION, Key.TAUGHT_M))
    return NavigationReport(
        report.stamp_ns,
        state,
        reason,
        task,
        command_ns,
        math.nan if left_m is None else left_m,
        request,
        refusal,
        teaching,
        taught_m or 0.0,
    )
