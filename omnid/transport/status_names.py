"""The entries of `<robot>/status`: names, keys, how severe what a part reports is, and what to do.

A part of the robot gives its numbers and states (`stats()`), with units in their keys, and its message by a key that is
the severity: _error, _stale, _warning or _ok. Of several messages that are not empty the most severe counts.
Every number is a value of its own, written as a decimal number. Messages are for people: programs do not parse them,
and they hold no number that changes from one report to the next. Keys that begin with "_" are not published.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, TypeAlias

import msgspec

from omnid.core.control.safety_rules import ASKED
from omnid.errors import OmnidError
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus, decode_diagnostics

PREFIX: Final = "omnid: "
ODOMETRY: Final = f"{PREFIX}odometry"
PAIRING: Final = f"{PREFIX}pairing"
CAMERAS: Final = f"{PREFIX}cameras"  # the advice for both; their entries end with " camera"
WHEELS: Final = f"{PREFIX}wheels"
BUS: Final = f"{PREFIX}bus"
RECORDING: Final = f"{PREFIX}recording"
RIG: Final = f"{PREFIX}rig"
MOTION: Final = f"{PREFIX}wheels and gyro"  # in addition to the cameras
PLACES: Final = f"{PREFIX}places"
MAP_FILE: Final = f"{PREFIX}map file"
NAVIGATION: Final = f"{PREFIX}navigation"  # on its own topic
IMAGES: Final = f"{PREFIX}images"  # parts of them that are frozen or blind
EXPOSURE: Final = f"{PREFIX}exposure"
CALIBRATION: Final = f"{PREFIX}calibration"  # of `omnid calibrate live`
SIMULATION: Final = f"{PREFIX}simulation"  # of a simulated robot whose time waits for the daemon
STAGE_PREFIX: Final = f"{PREFIX}stage "

STOPPED_PREFIX: Final = "stopped, "  # begins the keys that count stops of the wheels, by reason
REFUSED_PREFIX: Final = "refused, "  # begins the keys that count commands that are not valid, by reason
IGNORED_PREFIX: Final = "ignored, "  # begins the keys that count valid commands that may not drive, by reason

DISARMED_BY_STOP: Final = ASKED  # the value of disarmed_by after a stop
RUN_ID: Final = secrets.token_hex(4)  # of this program: one that starts again has another, and another odom
TIMEOUT_S: Final = 1.0  # An older image of a camera, or an older pose, is reported as missing.
# Share of the pairs that were dark, had lost parts, no sure pose or no place in a queue, from which there is a warning.
NOTABLE_SHARE: Final = 0.1


class Key(StrEnum):
    """Keys that several entries have, or that omnid's own programs read."""

    # An entry of the odometry with `state` is published when the state changes and has the stamp of that pose.
    STATE = "state"
    RUN = "run"  # identity of the daemon's run, of its odom: RUN_ID
    RESETS = "resets"
    INLIERS = "inliers"  # landmarks that agree with the pose
    TRACKED = "tracked"  # landmarks found in the images
    AGE_S = "age_s"  # of the newest pose or image
    RATE_HZ = "rate_hz"
    # Stages, cameras and pairing
    PROCESSED = "processed"
    DROPPED = "dropped"  # messages
    DROPS = "drops"
    ERRORS = "errors"
    LOSSES = "losses"
    RESTARTS = "restarts"
    BROKEN = "broken"
    UNPAIRED_LOWER = "unpaired_lower"
    UNPAIRED_UPPER = "unpaired_upper"
    # Calibration: pairs that are kept and needed; what is missing, in words, no key where there is enough; views from
    # the hub to the rim, 12 clockwise digits a ring, 9: nine or more
    PAIRS = "pairs"
    NEEDED = "needed"
    MISSING = "missing"
    LOWER_COVERAGE = "lower_coverage"
    UPPER_COVERAGE = "upper_coverage"
    # Wheels
    EXPIRIES = "expiries"
    SOURCE = "source"  # of the commands that drive; no key while none does
    ARMED = "armed"  # 1 or 0
    DISARMED_BY = "disarmed_by"  # the reason, no key while armed; DISARMED_BY_STOP after a stop
    REMEDY = "remedy"  # what to do, such as the way to arm; no key where nothing is needed
    REAL_TIME_FACTOR = "real_time_factor"  # simulated time over time on the wall


# Names of measured times: a time `work` has the keys work_p50_ms, work_p99_ms and work_max_ms (Histogram.times_ms).
WORK: Final = "work"
CAPTURE_TO_POSE: Final = "capture_to_pose"
TICK_LATE: Final = "tick_late"

Stats: TypeAlias = Mapping[Any, Any]  # the numbers of a part by their keys, and words
LEVELS: Final = {"_error": ERROR, "_stale": STALE, "_warning": WARN, "_ok": OK}  # of a message by its key

# What to do where a part is not well and gives no advice of its own.
REMEDIES: Final[Mapping[str, str]] = {
    ODOMETRY: "stop, then drive back slowly to a place that it has seen; check light and mirrors",
    PAIRING: "on the robot: omnid doctor",
    CAMERAS: "check its cable and its power; on the robot: omnid doctor",
    WHEELS: "remove the cause, then arm; on the robot: omnid doctor",
    BUS: "see bus.robot and bus.connect in the robot's configuration",
    RECORDING: "make room on the disk, or change record.folder",
    RIG: "omnid calibrate drive --only check on a recording; name the right rig.toml, or calibrate again",
    MOTION: "check motor.drive in the configuration, and the grip of the wheels",
    PLACES: "drive slowly to where the map was made; where everything has changed, make a new map",
    MAP_FILE: "make room on the disk, or change places.map",
    IMAGES: "clean the mirrors, look for glare and darkness, check the cameras and their driver",
    EXPOSURE: "in the dark switch lights on, drive more slowly and raise cameras.exposure_limit_ms, or clean the "
    "mirrors; in glare shade the mirrors, or put a filter before the lenses; where the images are good enough, set "
    'cameras.auto_exposure = "on"',
}


def entry(name: str, stats: Stats) -> DiagnosticStatus:
    """Return the entry of a part: its numbers, and level, words and advice; a part with a state alone reports that."""
    state = str(stats.get(Key.STATE, ""))
    found = [(level, str(stats[key])) for key, level in LEVELS.items() if stats.get(key)]
    level, message = found[0] if found else (ERROR if state == MapState.LOST else OK, state)
    values = {key: value for key, value in stats.items() if not key.startswith("_")}
    remedy = REMEDIES.get(CAMERAS if name.endswith(" camera") else name)
    if level != OK and remedy and not values.get(Key.REMEDY):
        values[Key.REMEDY] = remedy
    return DiagnosticStatus.of(name, level, message, values)


def by_reason(prefix: str, counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts by reason, of a copy: other threads add to them."""
    return {f"{prefix}{reason}": count for reason, count in sorted(dict(counts).items())}


def short_name(name: str) -> str:
    """Return the name of an entry without the daemon's."""
    return name.removeprefix(PREFIX)


def number(text: str) -> float | None:
    """Return a value as a finite number; None for any other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def tracking_state(message: str, values: Mapping[str, str]) -> TrackingState | None:
    """Return the tracking state in an entry of the odometry: its key `state`, else its message; None without one."""
    text = values.get(Key.STATE, message)
    return TrackingState(text) if text in list(TrackingState) else None


def with_reason(state: str, reason: str) -> str:
    """Return a state with its reason, for people."""
    return f"{state}: {reason}" if reason else str(state)


@dataclass(frozen=True, slots=True)
class NavigationReport:
    """State of goals, paths and routes; see omnid.core.navigation.requests for the states.

    The fields are keys of the entry NAVIGATION, which has none for what is unknown or empty.
    """

    stamp_ns: int = 0
    state: str = ""
    reason: str = ""  # of a stop or an end
    task: str = ""  # "goal", "path" or "route NAME"
    command_ns: int = 0  # stamp of the goal or path that it follows from; 0 without
    left_m: float = math.nan  # way to the end; NaN unknown
    request: str = ""  # the newest one
    refusal: str = ""  # empty where it was accepted
    teaching: str = ""  # name of the route that is recorded
    taught_m: float = 0.0

    @property
    def words(self) -> str:
        """The state with the reason."""
        return with_reason(self.state, self.reason)


def decode_navigation(payload: bytes, _: bytes = b"") -> NavigationReport:
    """Decode the state of the navigation. Raise OmnidError for any other bytes."""
    report = decode_diagnostics(payload)
    values = next((status.values for status in report.statuses if status.name == NAVIGATION), {})
    try:
        return msgspec.convert({**values, "stamp_ns": report.stamp_ns}, NavigationReport, strict=False)
    except msgspec.ValidationError as error:
        raise OmnidError(f"no report of the navigation: {error}; check the sender") from error
