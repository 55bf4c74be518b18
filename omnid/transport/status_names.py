"""The entries of `<robot>/status`: names, keys, and one table that turns numbers into severities and words.

A part of the robot gives its numbers (`stats()`), with units in their keys. The first of its rules that holds gives
level and message. Every number is a value of its own, written as a decimal number. Messages are for people: programs
do not parse them, and they hold no number that changes from one report to the next. Keys that begin with "_" serve the
rules alone and are not published.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, NamedTuple, TypeAlias

import msgspec

from omnid.core.control.arming import STARTED
from omnid.core.control.safety_rules import ASKED, AWAITED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
from omnid.engine.telemetry import Histogram
from omnid.errors import OmnidError
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus, decode_diagnostics

PREFIX: Final = "omnid: "
ODOMETRY: Final = f"{PREFIX}odometry"
PAIRING: Final = f"{PREFIX}pairing"
CAMERAS: Final = f"{PREFIX}cameras"  # the rules of both; their entries are named by camera_name
WHEELS: Final = f"{PREFIX}wheels"
BUS: Final = f"{PREFIX}bus"
CLOCK: Final = f"{PREFIX}clock"  # of the computer, whose steps the stamps follow
RECORDING: Final = f"{PREFIX}recording"
RIG: Final = f"{PREFIX}rig"
MOTION: Final = f"{PREFIX}wheels and gyro"  # in addition to the cameras
PLACES: Final = f"{PREFIX}places"
MAP_FILE: Final = f"{PREFIX}map file"
NAVIGATION: Final = f"{PREFIX}navigation"  # on its own topic
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
TIMEOUT_S: Final = 1.0  # An older image of a camera, or an older pose, is reported as missing.
STEP_S: Final = 60.0  # The status warns of a step of the clock for this time: people look at it now and then.
# Share of the pairs that were dark, had lost parts, no sure pose or no place in a queue, from which there is a warning.
NOTABLE_SHARE: Final = 0.1
LIVE: Final = "all parts are live"  # of the images
HINDERED: Final = (NavigationState.BLOCKED, NavigationState.NOT_LOCALISED, NavigationState.PAUSED)


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
    MISSED = "missed"  # deadlines of a ticker
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
    # Navigation
    TASK = "task"  # such as "goal" or "route NAME"; no key without one
    REASON = "reason"  # of a halt or an end
    COMMAND_NS = "command_ns"  # stamp of the request that the task follows from; no key without one
    LEFT_M = "left_m"  # way to the end of the path
    TEACHING = "teaching"  # name of the route that is recorded
    TAUGHT_M = "taught_m"
    REQUEST = "request"  # the newest one, in a word
    REFUSAL = "refusal"  # why it is refused; no key where it was accepted


# Names of measured times: a time `work` has the keys work_p50_ms, work_p99_ms and work_max_ms.
WORK: Final = "work"
CAPTURE_TO_POSE: Final = "capture_to_pose"
CAPTURE_TO_WHEEL: Final = "capture_to_wheel"
TICK_LATE: Final = "tick_late"
_TIME_SUFFIX: Final = "_ms"

Stats: TypeAlias = Mapping[Any, Any]  # the numbers of a part by their keys
Level: TypeAlias = int | Callable[[Stats], int]


class Part(NamedTuple):
    """A part of the robot: the usual advice where it is not well, and rules, of which the first that holds counts.

    A rule has a level, a condition on the numbers, and words with keys of the numbers in braces. A condition that is a
    key holds where that number is there and not 0 or empty; "" always holds.
    """

    remedy: str
    rules: tuple[tuple[Level, str | Callable[[Stats], object], str], ...]


def _of_pose(s: Stats) -> int:
    """Return the level of the state of a pose."""
    return {TrackingState.TRACKING: OK, TrackingState.DEGRADED: WARN, TrackingState.LOST: ERROR}[s["_state"]]


def _of_wheels(s: Stats) -> int:
    """Return ERROR for a motor controller that has failed, but not while it boots; WARN for an unwanted stop."""
    boots = s["_reason"] == AWAITED and not s["_overdue"]
    if (s["_reason"] == FAILED or s["_failed"] or s["fault"]) and not boots:
        return ERROR
    return WARN if s["_slow"] or s["_stop"] not in ("", IDLE, ASKED, COMMAND_STALE, STARTED) else OK


PARTS: Final[Mapping[str, Part]] = {
    ODOMETRY: Part(
        "stop, then drive back slowly to a place that it has seen; check light and mirrors",
        (
            (STALE, lambda s: not s, "no pose yet"),
            (STALE, lambda s: s[Key.AGE_S] > TIMEOUT_S, "no new pose"),
            (WARN, lambda s: s["_is_dark"] and s["_state"] != TrackingState.LOST, "{_state}: it is too dark"),
            (lambda s: max(WARN, _of_pose(s)), "_fault", "{_state}: {_fault}"),
            (_of_pose, "", "{_state}"),
        ),
    ),
    PAIRING: Part(
        "on the robot: omnid doctor",
        (
            (WARN, "_missing", "no images of the {_missing} camera"),
            (WARN, lambda s: s["_broken_hz"] > 0, "images cannot be decoded; the first: {_fault}"),
            (
                WARN,
                "_frozen",
                "the images of the {_frozen} camera are frozen: all pixels are as before; check the camera and its "
                "driver",
            ),
            (
                WARN,
                lambda s: s["_dropped_hz"] > NOTABLE_SHARE * (s["_taken_hz"] + s["_dropped_hz"]),
                "too slow: the computer leaves images out; close other programs on it, or start omnid with "
                "--profile small",
            ),
            (
                WARN,
                lambda s: s["_pairs_hz"] == 0,
                "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them",
            ),
            (
                WARN,
                lambda s: s["_is_fixed"] and abs(s["skew_ms"]) > s["tolerance_ms"] / 2,
                "the cameras' images are nearly as far apart in time as pair.tolerance_ms allows: synchronise them",
            ),
            (OK, "exposure_skew_ms", "not synchronised: the motion between the exposures is corrected"),
            (OK, "", "synchronised"),
        ),
    ),
    CAMERAS: Part(
        "check its cable and its power; on the robot: omnid doctor",
        (
            (ERROR, lambda s: s["_status"] == "lost", "{_problem}"),
            (ERROR, lambda s: s["_status"] == "streaming" and not s[Key.AGE_S] <= TIMEOUT_S, "no new image"),
            (OK, "", "{_status}"),
        ),
    ),
    WHEELS: Part(
        "remove the cause, then arm; on the robot: omnid doctor",
        (
            (_of_wheels, lambda s: s["_reason"] == NOT_ARMED and s["_stop"] != STARTED, "not armed: {_stop}"),
            (_of_wheels, lambda s: s["_stop"] == AWAITED, "{_stop}: {problem}"),
            (_of_wheels, lambda s: not s["_stop"] and s["_is_blocked"], "stopped: {obstacle}"),
            (_of_wheels, "_slow", "driving slowly: {_slow}"),
            (_of_wheels, "_stop", "{_stop}"),
            (_of_wheels, "", "driving"),
        ),
    ),
    BUS: Part(
        "see bus.robot and bus.connect in the robot's configuration",
        (
            (WARN, "_awaited_router", "no router yet at {_awaited_router}"),
            (ERROR, "_same_name", "{_same_name}"),
            (WARN, "_flood", "more messages on {_flood} than are taken: end their sender"),
            (OK, "", "open"),
        ),
    ),
    CLOCK: Part(
        "",
        (
            (OK, lambda s: not s["steps"], "followed"),
            (WARN, lambda s: s["since_s"] < STEP_S, "it was set {_step}: the stamps follow it"),
            (OK, "", "it was set {_step}: the stamps follow it"),
        ),
    ),
    RECORDING: Part(
        "make room on the disk, or change record.folder",
        ((ERROR, lambda s: s["_status"] == "stopped", "{_words}"), (OK, "", "{_words}")),
    ),
    RIG: Part(
        "omnid calibrate drive --only check on a recording; name the right rig.toml, or calibrate again",
        (
            (ERROR, lambda s: s["_warning"] and s[Key.STATE] in ("exchanged", "broken"), "{_warning}"),
            (WARN, "_warning", "{_warning}"),
            (OK, lambda s: s[Key.STATE] == "unchecked", "not checked yet: the robot must drive past different places"),
            (OK, lambda s: s[Key.STATE] == "fits", "fits"),
            (
                WARN,
                lambda s: s[Key.STATE] == "drifted",
                "drifted: run omnid calibrate drive --only check on a recording; -o corrects the rotation of the upper "
                "camera",
            ),
            (
                ERROR,
                lambda s: s[Key.STATE] == "exchanged",
                "the cameras are exchanged: exchange them in the configuration",
            ),
            (
                ERROR,
                "",
                "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: run omnid "
                "calibrate drive --only check on a recording",
            ),
        ),
    ),
    MOTION: Part(
        "check motor.drive in the configuration, and the grip of the wheels",
        (
            (
                WARN,
                "_is_wrong",
                "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped){_detail}",
            ),
            (WARN, "_is_slipping", "wheels slip"),
            (WARN, "_differs", "{_differs}"),
        ),
    ),
    PLACES: Part(
        "drive slowly to where the map was made; where everything has changed, make a new map",
        ((ERROR, lambda s: s[Key.STATE] == MapState.LOST, "{state}"), (OK, "", "{state}")),
    ),
    MAP_FILE: Part(
        "make room on the disk, or change places.map", ((ERROR, "_error", "{_error}"), (OK, "", "saves the map"))
    ),
    NAVIGATION: Part(
        "",
        (
            (ERROR, lambda s: s[Key.STATE] == NavigationState.FAILED, "{_words}"),
            (WARN, lambda s: s[Key.STATE] in HINDERED, "{_words}"),
            (OK, "", "{_words}"),
        ),
    ),
    IMAGES: Part(
        "clean the mirrors, look for glare and darkness, check the cameras and their driver",
        (
            (STALE, lambda s: not s, "no pose yet"),
            (ERROR, "_lost", "{_lost}"),
            (OK, "", LIVE),
        ),
    ),
    FLOOR: Part(
        "state the height of the cameras in the rig: omnid calibrate drive --only height",
        (
            (OK, "_is_stated", "the rig states the height of the cameras"),
            (WARN, "height_m", "the height of the cameras is that which the images show"),
            (WARN, "", "the height of the cameras is not known: nothing is free"),
        ),
    ),
    EXPOSURE: Part(
        "in the dark switch lights on, drive more slowly and raise cameras.exposure_limit_ms, or clean the mirrors; in "
        "glare shade the mirrors, or put a filter before the lenses; where the images are good enough, set "
        'cameras.auto_exposure = "on"',
        (
            (OK, lambda s: not s, "no images yet"),
            (WARN, lambda s: s["_state"] != "regulated", "{_state}: {_reason}"),
            (OK, "_reason", "{_reason}"),
            (OK, "", "{_state}"),
        ),
    ),
    SIMULATION: Part("", ((OK, "", "its time waits for the daemon"),)),
    SUMMARY: Part("", ((OK, "", "the run has ended"),)),
    CALIBRATION: Part("", ((OK, "", "{_outcome}"),)),
}


def entry(name: str, stats: Stats) -> DiagnosticStatus:
    """Return the entry of a part: its numbers, and level, words and advice by its rules."""
    remedy, rules = PARTS.get(CAMERAS if name.endswith(" camera") else name, Part("", ()))
    level, _, words = next(
        rule
        for rule in (*rules, (OK, "", ""))
        if (rule[1](stats) if callable(rule[1]) else not rule[1] or stats.get(rule[1]))
    )
    found = level(stats) if callable(level) else level
    values = {key: value for key, value in stats.items() if not key.startswith("_")}
    if found != OK and remedy and not values.get(Key.REMEDY):
        values[Key.REMEDY] = remedy
    return DiagnosticStatus.of(name, found, words.format_map(stats), values)


def by_reason(prefix: str, counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts by reason, of a copy: other threads add to them."""
    return {f"{prefix}{reason}": count for reason, count in sorted(dict(counts).items())}


def times(name: str, histogram: Histogram) -> dict[str, float]:
    """Return median, 99th percentile and maximum in ms; nothing before the first measurement."""
    if not histogram.count:
        return {}
    found = zip(("p50", "p99", "max"), (*histogram.quantiles(0.5, 0.99), histogram.max_s), strict=True)
    return {time_key(name, statistic): 1e3 * value_s for statistic, value_s in found}


def camera_name(camera: str) -> str:
    """Return the name of a camera's entry."""
    return f"{PREFIX}{camera} camera"


def stage_name(stage: str) -> str:
    """Return the name of a stage's entry."""
    return f"{STAGE_PREFIX}{stage}"


def short_name(name: str) -> str:
    """Return the name of an entry without the daemon's."""
    return name.removeprefix(PREFIX)


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

    stamp_ns: int = 0
    state: str = ""
    reason: str = ""  # of a halt or an end
    task: str = ""  # "goal", "path" or "route NAME"
    command_ns: int = 0  # stamp of the goal or path that it follows from; 0 without
    left_m: float = math.nan  # way to the end; NaN unknown
    request: str = ""  # the newest one
    refusal: str = ""  # empty where it was accepted
    teaching: str = ""  # name of the route that is recorded
    taught_m: float = 0.0


def decode_navigation(payload: bytes, _: bytes = b"") -> NavigationReport:
    """Decode the state of the navigation. Raise OmnidError for any other bytes."""
    report = decode_diagnostics(payload)
    values = next((status.values for status in report.statuses if status.name == NAVIGATION), {})
    try:
        return msgspec.convert({**values, "stamp_ns": report.stamp_ns}, NavigationReport, strict=False)
    except msgspec.ValidationError as error:
        raise OmnidError(f"no report of the navigation: {error}; check the sender") from error
