"""Status of a live daemon and of a run: the numbers of each part, and what they mean, in entries of one form.

An entry has the numbers of its part, and a table of conditions: the first that holds gives its level and its words.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera
from omnid.controller.statistics import ControllerStatistics
from omnid.core.control.arming import STARTED
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.safety_rules import ASKED, AWAITED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.obstacles.unwatched import Unwatched
from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, GYRO_OFFSET, TURN, WHEEL_OFFSET
from omnid.core.rig.column_finding import RigState
from omnid.core.rig.rig_health import VIEWS, RigHealth
from omnid.core.stereo.tiles import SIDES, Side, TileStates
from omnid.diagnostics.run_summary import NOTABLE_SHARE, RunCounters, RunStatistics
from omnid.engine.robot_clock import RobotClock
from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.messages import OdometryUpdate
from omnid.stages.motion_inbox import MotionInbox
from omnid.stages.obstacles import CameraFloor
from omnid.stages.odometry import OdometryStage
from omnid.stages.places import Places
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import MapState, TrackingState
from omnid.transport import status_names
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus
from omnid.transport.commands import CommandReceiver, SensorReceiver
from omnid.transport.status_names import Key, lost_parts_key, time_key

TIMEOUT_S: Final = 1.0  # An older image of a camera, or an older pose, is reported as missing.
STEP_S: Final = 60.0  # The status warns of a step of the clock for this time: people look at it now and then.

LEVELS: Final = {TrackingState.TRACKING: OK, TrackingState.DEGRADED: WARN, TrackingState.LOST: ERROR}
RIG_STATES: Final = {
    RigState.UNCHECKED: (OK, "not checked yet: the robot must drive past different places"),
    RigState.FITS: (OK, "fits"),
    RigState.DRIFTED: (
        WARN,
        "drifted: run omnid calibrate drive --only check on a recording; -o corrects the rotation of the upper camera",
    ),
    RigState.EXCHANGED: (ERROR, "the cameras are exchanged: exchange them in the configuration"),
    RigState.BROKEN: (
        ERROR,
        "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: run omnid "
        "calibrate drive --only check on a recording",
    ),
}
LIVE: Final = "all parts are live"
FIXED: Final = (
    "a part of the panoramas shows what is fixed to a camera, such as the reflection of its lens: "
    "obstacles are judged without it; `omnid calibrate drive --only mask` on a log of a turn makes a mask of it"
)
WRONG_WHEELS: Final = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
NO_FAULTS: Final = ("", IDLE, ASKED, COMMAND_STALE, STARTED)  # reasons for a stop that are no fault
_CAMERA_COUNTERS: Final = ("frames", Key.DROPS, Key.ERRORS, "restamped", Key.RESTARTS, Key.LOSSES, "reopens")
_WHEEL_COUNTERS: Final = ("sent", "late", Key.ERRORS, Key.EXPIRIES, "fault", "lost_reports", "slowed")

Case: TypeAlias = tuple[object, int, str]  # condition, level, words


def entry(name: str, values: Mapping[Any, object], *cases: Case, words: str = "") -> DiagnosticStatus:
    """Return an entry with the level and the words of the first case whose condition holds; else OK, with `words`."""
    level, message = next(((level, message) for holds, level, message in cases if holds), (OK, words))
    return DiagnosticStatus.of(name, level, message, values)


def times(name: str, histogram: Histogram) -> dict[str, float]:
    """Return median, 99th percentile and maximum in ms; nothing before the first measurement."""
    if not histogram.count:
        return {}
    found = zip(("p50", "p99", "max"), (*histogram.quantiles(0.5, 0.99), histogram.max_s), strict=True)
    return {time_key(name, statistic): 1e3 * value_s for statistic, value_s in found}


def by_reason(prefix: str, counts: Mapping[str, int]) -> dict[str, object]:
    """Return counts by reason, of a copy: other threads add to them."""
    return {f"{prefix}{reason}": count for reason, count in sorted(dict(counts).items())}


@dataclass
class StatusCollector:
    """Makes the entries of all parts of a live run, with rates since the call before."""

    telemetry: Telemetry
    cameras: Mapping[Camera, CameraState]
    pair: Synchronise
    statistics: RunStatistics
    to_pose: Histogram  # s, from the capture of images to their pose
    controller: ControllerStatistics | None
    commands: CommandReceiver | None
    others: Iterable[Callable[[], DiagnosticStatus]] = ()  # parts that make their own entries
    clock_ns: Callable[[], int] = time.monotonic_ns  # the clock of the stamps of images and poses
    _before: dict[str, int] = field(default_factory=dict)  # counts of the last report
    _before_s: float = field(default_factory=time.monotonic)
    _span_s: float = math.nan

    def __call__(self) -> list[DiagnosticStatus]:
        """Return one entry for each part."""
        now_s = time.monotonic()
        self._span_s, self._before_s = now_s - self._before_s, now_s
        found = [self._odometry(), self._pairing(), *map(self._camera, self.cameras)]
        if self.controller is not None:
            found.append(_wheels(self.controller, self.commands))
        stages = (stage_status(stage, self._rate_hz(stage.name, stage.processed)) for stage in self.telemetry.stages)
        return [*found, *(status() for status in self.others), *stages]

    def _rate_hz(self, name: str, count: int) -> float:
        """Return by how much the counter of that name has grown per second since the last report."""
        before, self._before[name] = self._before.get(name, 0), count
        return (count - before) / self._span_s if self._span_s > 0 else math.nan

    def _age_s(self, stamp_ns: int) -> float:
        return (self.clock_ns() - stamp_ns) * 1e-9 if stamp_ns else math.nan

    def _odometry(self) -> DiagnosticStatus:
        newest = self.statistics.newest
        if newest is None:
            return entry(status_names.ODOMETRY, {}, (True, STALE, "no pose yet"))
        state, level, age_s = newest.state, LEVELS[newest.state], self._age_s(newest.stamp_ns)
        values = {
            Key.RATE_HZ: self._rate_hz("poses", self.statistics.poses),
            Key.AGE_S: age_s,
            Key.INLIERS: newest.inliers,
            Key.TRACKED: newest.tracks,
            Key.RUN: status_names.RUN_ID,
            Key.RESETS: newest.reset_counter,
            Key.LENGTH_M: self.statistics.length_m,
            "level_grey": newest.light.level_grey,
            "contrast_to_noise": newest.light.contrast_to_noise,
            **times(status_names.CAPTURE_TO_POSE, self.to_pose),
        }
        return entry(
            status_names.ODOMETRY,
            values,
            (age_s > TIMEOUT_S, STALE, "no new pose"),
            (newest.light.is_too_dark and state != TrackingState.LOST, WARN, f"{state}: it is too dark"),
            (newest.image_fault, max(WARN, level), f"{state}: {newest.image_fault}"),
            (True, level, str(state)),
        )

    def _pairing(self) -> DiagnosticStatus:
        pair, skew = self.pair, self.pair.skew
        rate_hz, broken_hz = (self._rate_hz(name, pair.counts[name]) for name in ("pairs", "broken"))
        images = self.telemetry.of("pair")
        taken_hz, dropped_hz = (
            self._rate_hz(f"pair {name}", getattr(images, name)) for name in ("processed", "dropped")
        )
        missing = [name for name, stamp_ns in pair.newest_ns.items() if not self._age_s(stamp_ns) <= TIMEOUT_S]
        frozen = " and the ".join(pair.frozen)
        tolerance_ms, skew_ms = pair.tolerance_ms, skew.mean_ns * 1e-6
        values = {
            **pair.counts,
            "skew_ms": skew_ms,
            "max_skew_ms": skew.max_ns * 1e-6,
            "exposure_skew_ms": skew.exposure_ns * 1e-6,
            "tolerance_ms": tolerance_ms,
        }
        apart = "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them"
        nearly = "the cameras' images are nearly as far apart in time as pair.tolerance_ms allows: synchronise them"
        return entry(
            status_names.PAIRING,
            values,
            (missing, WARN, f"no images of the {' and the '.join(missing)} camera"),
            (broken_hz > 0, WARN, f"images cannot be decoded; the first: {pair.fault}"),
            (
                frozen,
                WARN,
                f"the images of the {frozen} camera are frozen: all pixels are as before; check the camera and its "
                "driver",
            ),
            (
                dropped_hz > NOTABLE_SHARE * (taken_hz + dropped_hz),
                WARN,
                "too slow: the computer leaves images out; close other programs on it, or start omnid with "
                "--profile small",
            ),
            (rate_hz == 0, WARN, apart),
            (pair.has_fixed_tolerance and abs(skew_ms) > tolerance_ms / 2, WARN, nearly),
            (skew.exposure_ns, OK, "not synchronised: the motion between the exposures is corrected"),
            words="synchronised",
        )

    def _camera(self, name: Camera) -> DiagnosticStatus:
        state, age_s = self.cameras[name], self._age_s(self.pair.newest_ns[name])
        values = {"mode": state.mode, Key.RATE_HZ: self._rate_hz(f"{name} frames", state.frames), Key.AGE_S: age_s}
        return entry(
            status_names.camera_name(name),
            values | {key: getattr(state, key) for key in _CAMERA_COUNTERS},
            (state.status == "lost", ERROR, state.problem),
            (state.status == "streaming" and not age_s <= TIMEOUT_S, ERROR, "no new image"),
            words=str(state.status),
        )


def _wheels(controller: ControllerStatistics, commands: CommandReceiver | None) -> DiagnosticStatus:
    state = controller.state  # read once, for another thread replaces it
    # 1. Counters, and times.
    values: dict[str, object] = {key: getattr(state, key) for key in _WHEEL_COUNTERS}
    values |= by_reason(status_names.STOPPED_PREFIX, state.stops)
    values |= by_reason(status_names.IGNORED_PREFIX, state.refused)
    if commands is not None:
        values |= {Key.COMMANDS: commands.accepted, Key.STOPS: commands.stops}
        values |= {Key.COMMAND_REFUSAL: commands.refusal}
        values |= by_reason(status_names.REFUSED_PREFIX, commands.refused)
    late = controller.lateness
    values |= times(status_names.CAPTURE_TO_WHEEL, controller.to_wheel) | times(status_names.TICK_LATE, late)
    # 2. Arming, the source of the commands, obstacles, and what to do.
    arm = "send cmd/arm: `omnid arm`" if state.needs_request else ""
    values |= {
        time_key(status_names.TICK_LATE, "p999"): 1e3 * late.p(0.999),
        Key.ARMED: int(state.armed),
        Key.DISARMED_BY: state.disarmed_by,
        Key.REMEDY: remedy(state.obstacle) if state.blocked else arm,
        Key.ARM_REFUSAL: state.arm_answer.refusal,
        Key.SOURCE: state.source,
        Key.OBSTACLE: state.obstacle,
        Key.OBSTACLE_STOPS: state.obstacle_stops,
        Key.PROBLEM: state.problem,
        Key.MEASURED: state.measured,
        "battery_v": state.battery_v,
    }
    # 3. Whether the wheels turn, and why not.
    slow = state.slowed_by or state.obstacle
    reason = state.disarmed_by if state.reason == NOT_ARMED else state.reason
    has_failed = state.reason == FAILED or state.failed or state.fault
    boots = state.reason == AWAITED and not state.overdue
    is_slowed = not reason and slow
    level = ERROR if has_failed and not boots else WARN if is_slowed or reason not in NO_FAULTS else OK
    return entry(
        status_names.WHEELS,
        values,
        (state.reason == NOT_ARMED and reason != STARTED, level, f"not armed: {reason}"),
        (reason == AWAITED, level, f"{AWAITED}: {state.problem}"),
        (not reason and state.blocked, level, f"stopped: {state.obstacle}"),
        (is_slowed, level, f"driving slowly: {slow}"),
        (True, level, reason or "driving"),
    )


def stage_status(stage: StageStats, rate_hz: float = math.nan) -> DiagnosticStatus:
    """Return the entry of a stage: work is the time for a message."""
    lost = Key.MISSED if stage.is_ticker else Key.DROPPED
    work = times(status_names.WORK, stage.wall)
    values = {Key.RATE_HZ: rate_hz, Key.PROCESSED: stage.processed, lost: stage.dropped, **work}
    return entry(status_names.stage_name(stage.name), values)


def summary_status(counters: RunCounters) -> DiagnosticStatus:
    """Return the entry of a finished replay: its counters, one number per key."""
    groups: dict[str, Mapping[Any, int]] = {
        "poses": counters.states,
        "dropped": counters.drops,
        "map": counters.map,
        "places": counters.places,
        "motor": counters.motor,
    }
    values = {
        "pairs": counters.pairs,
        "poses": counters.poses,
        Key.LENGTH_M: f"{counters.length_m:.4f}",
        Key.RESETS: counters.resets,
        **{f"{group}_{name}": count for group, counts in groups.items() for name, count in counts.items()},
    }
    return entry(status_names.SUMMARY, values, words="the run has ended")


def rig_status(health: RigHealth) -> DiagnosticStatus:
    """Return the state of the rig, and the evidence of the newest finding."""
    finding, start = health.finding, health.start_finding
    values: dict[str, object] = {Key.STATE: health.state, "new_views": health.new_views, "needed_views": VIEWS}
    if start is not None:
        values["exchanged_matches"] = start.exchanged_matches
    if (newest := finding or start) is not None:
        values |= {name: getattr(newest, name) for name in ("turn_deg", "offset_px", "left_px", "matches", "tried")}
    if finding is not None:
        values["age_s"] = health.finding_age_s
    level, words = RIG_STATES[health.state]
    # The words of the first pairs count while the drive has shown nothing.
    of_start = (finding is None and health.warning, max(level, WARN), health.warning)
    return entry(status_names.RIG, values, of_start, (True, level, words))


def floor_status(camera_floor: CameraFloor) -> DiagnosticStatus:
    """Return where the height comes from, and its figures; a warning while it is not stated."""
    floor, values = camera_floor.floor, dict[Any, object]()
    if floor is not None:
        values = {Key.HEIGHT_M: floor.height_m, Key.SIGMA_M: floor.sigma_m, Key.TILT_DEG: math.degrees(floor.tilt_rad)}
    return entry(
        status_names.FLOOR,
        values,
        (floor is None, WARN, "the height of the cameras is not known: nothing is free"),
        (camera_floor.stated is None, WARN, "the height of the cameras is that which the images show"),
        words="the rig states the height of the cameras",
    )


def places_status(places: Places) -> DiagnosticStatus:
    """Return the state of the pose in the map, and the sizes and counters of the map."""
    state = places.state
    return entry(
        status_names.PLACES,
        {Key.STATE: state, **places.counts},
        (state is MapState.LOST, ERROR, state),
        words=state,
    )


def motion_status(
    odometry: OdometryStage, inbox: MotionInbox, receiver: SensorReceiver | None = None
) -> DiagnosticStatus:
    """Return the entry of wheels and gyro: samples, their estimated errors with sigmas, and the sensor that differs."""
    sensors, witness = odometry.sensors, odometry.witness
    values: dict[str, object] = {
        "wheel_samples": inbox.wheels,
        "gyro_samples": inbox.gyro,
        "dropped": inbox.dropped,
        "slips": sensors.slips,
        "refused_gyro": sensors.refused,
    }
    estimated: dict[str, tuple[int, float]] = {}  # state of the filter, and the unit
    if sensors.steps and inbox.wheels:
        estimated |= {"wheel_scale": (DISTANCE, 1.0), "turn_scale": (TURN, 1.0), "wheel_offset_ms": (WHEEL_OFFSET, 1e3)}
    if sensors.steps and inbox.gyro:
        estimated |= {"gyro_offset_ms": (GYRO_OFFSET, 1e3)}
        estimated |= {f"gyro_bias_{axis}_radps": (BIAS.start + k, 1.0) for k, axis in enumerate("xyz")}
    values |= {name: unit * float(sensors.values[state]) for name, (state, unit) in estimated.items()}
    values |= {f"{name}_sigma": unit * float(sensors.sigmas[state]) for name, (state, unit) in estimated.items()}
    if receiver is not None:
        values |= by_reason(status_names.REFUSED_PREFIX, receiver.refused)
    differs = f"{witness.reason} {witness.detail}".strip()
    wrong = f"{WRONG_WHEELS}: {witness.detail}" if witness.detail else WRONG_WHEELS
    return entry(
        status_names.MOTION,
        values,
        (not sensors.wheels_are_sane, WARN, wrong),
        (sensors.is_slipping, WARN, "wheels slip"),
        (differs, WARN, differs),
    )


def clock_status(clock: RobotClock) -> DiagnosticStatus:
    """Return whether the computer's clock was set while the robot ran, and by how much."""
    clock.follow()
    if not clock.steps:
        return entry(status_names.CLOCK, {"steps": 0}, words="followed")
    since_s = (clock.monotonic_ns() - clock.step.at_ns) * S_PER_NS
    values = {"steps": clock.steps, "step_s": f"{clock.step.change_ns * S_PER_NS:.3f}", "since_s": round(since_s)}
    words = f"it was set {clock.step.words}: the stamps follow it"
    return entry(status_names.CLOCK, values, (since_s < STEP_S, WARN, words), words=words)


def simulation_status(values: Mapping[str, float]) -> DiagnosticStatus:
    """Return the numbers of a simulated robot."""
    return entry(status_names.SIMULATION, values, words="its time waits for the daemon")


def images_status(unwatched: Unwatched, newest: OdometryUpdate | None, fixed_share: float) -> DiagnosticStatus:
    """Return the parts of the newest pair that are frozen or blind, and how long.

    fixed_share: of the panoramas, which shows what is fixed to a camera.
    """
    if newest is None:
        return entry(status_names.IMAGES, {}, (True, STALE, "no pose yet"))
    tiles = newest.depth.panoramas.tiles
    lost = [side for side in SIDES if side in tiles.columns and tiles.columns[side].any()]
    values: dict[str, object] = {
        lost_parts_key(side): round((newest.stamp_ns - tiles.since_ns[side]) * 1e-9) for side in lost
    }
    if fixed_share:
        values[status_names.FIXED_PERCENT] = round(100 * fixed_share)
    message = "; ".join(_lost_parts(unwatched, side, tiles) for side in lost)
    return entry(status_names.IMAGES, values, (lost, ERROR, message), (fixed_share, OK, FIXED), words=LIVE)


def _lost_parts(unwatched: Unwatched, side: Side, tiles: TileStates) -> str:
    """Return what a camera does not show, such as "the upper camera is blind from 300 to 40 degrees"."""
    columns, is_dead = tiles.columns[side], tiles.dead[side].any(axis=0)
    parts = []
    for word, found in (("frozen", columns & is_dead), ("blind", columns & ~is_dead)):
        spans = unwatched.spans_deg(found) if found.any() else []
        where = " and ".join(f"from {begin} to {end} degrees" for begin, end in spans)
        parts += [f"{word} {'all around' if spans == [(0, 360)] else where}"] if spans else []
    return f"the {side} camera is {' and '.join(parts)}"
