"""Status of a live daemon as diagnostic entries: odometry, pairing, cameras, wheels and stages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera
from omnid.controller.statistics import ControllerStatistics
from omnid.core.control.arming import STARTED
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.safety_rules import ASKED, AWAITED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
from omnid.diagnostics.run_summary import RunCounters, RunStatistics
from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.messages import OdometryUpdate
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus
from omnid.transport.commands import CommandReceiver
from omnid.transport.status_names import Key, time_key

# If the skew between the cameras changes by more, their clocks run at different rates.
MAX_SKEW_DRIFT_NS: Final = 3_000_000
TIMEOUT_S: Final = 1.0  # An older image of a camera, or an older pose, is reported as missing.
NO_FAULTS: Final = ("", IDLE, ASKED, COMMAND_STALE, STARTED)  # reasons for a stop that are no fault
REMEDY: Final = "send cmd/arm: `omnid arm`"
LEVELS: Final = {TrackingState.TRACKING: OK, TrackingState.DEGRADED: WARN, TrackingState.LOST: ERROR}
_CAMERA_COUNTERS: Final = ("frames", Key.DROPS, Key.ERRORS, "restamped", Key.RESTARTS, Key.LOSSES, "reopens")
_WHEEL_COUNTERS: Final = ("sent", "late", Key.ERRORS, Key.EXPIRIES, "fault", "lost_reports", "slowed")


class StatusSources(NamedTuple):
    """The parts of a live run that the report is made of."""

    telemetry: Telemetry
    cameras: Mapping[Camera, CameraState]
    pair: Synchronise
    statistics: RunStatistics
    to_pose: Histogram  # s, from the capture of images to their pose
    controller: ControllerStatistics | None
    commands: CommandReceiver | None
    others: tuple[Callable[[], DiagnosticStatus], ...] = ()  # parts that make their own entries
    clock_ns: Callable[[], int] = time.monotonic_ns  # the clock of the stamps of images and poses


class StatusCollector:
    """Makes the entries of all parts."""

    def __init__(self, sources: StatusSources) -> None:
        self._sources = sources
        self._before: dict[str, int] = {}  # counts of the last report
        self._before_s, self._span_s = time.monotonic(), math.nan

    def __call__(self) -> list[DiagnosticStatus]:
        """Return one entry for each part."""
        now_s, sources = time.monotonic(), self._sources
        self._span_s, self._before_s = now_s - self._before_s, now_s
        entries = [self._odometry(), self._pairing(), *self._cameras()]
        if sources.controller is not None:
            entries.append(_wheels(sources.controller, sources.commands))
        return [*entries, *(status() for status in sources.others), *map(self._stage, sources.telemetry.stages)]

    def _rate_hz(self, name: str, count: int) -> float:
        """Return by how much the counter of that name has grown per second since the last report."""
        before, self._before[name] = self._before.get(name, 0), count
        return (count - before) / self._span_s if self._span_s > 0 else math.nan

    def _age_s(self, stamp_ns: int) -> float:
        return (self._sources.clock_ns() - stamp_ns) * 1e-9

    def _odometry(self) -> DiagnosticStatus:
        statistics, newest = self._sources.statistics, self._sources.statistics.newest
        if newest is None:
            return DiagnosticStatus(status_names.ODOMETRY, STALE, "no pose yet", {})
        level, message = LEVELS[newest.state], str(newest.state)
        if self._age_s(newest.stamp_ns) > TIMEOUT_S:
            level, message = STALE, "no new pose"
        elif newest.light.is_too_dark and newest.state != TrackingState.LOST:
            level, message = WARN, f"{newest.state}: it is too dark"
        elif newest.image_fault:
            level, message = max(WARN, level), f"{newest.state}: {newest.image_fault}"
        values = {
            Key.RATE_HZ: self._rate_hz("poses", statistics.poses),
            Key.AGE_S: self._age_s(newest.stamp_ns),
            Key.INLIERS: newest.inliers,
            Key.TRACKED: newest.tracks,
            Key.RUN: status_names.RUN_ID,
            Key.RESETS: newest.reset_counter,
            Key.LENGTH_M: statistics.length_m,
            "level_grey": newest.light.level_grey,
            "contrast_to_noise": newest.light.contrast_to_noise,
            **_times(status_names.CAPTURE_TO_POSE, self._sources.to_pose),
        }
        return DiagnosticStatus.of(status_names.ODOMETRY, level, message, values)

    def _pairing(self) -> DiagnosticStatus:
        pair, skew = self._sources.pair, self._sources.pair.skew
        fault = self._pairing_fault(pair)
        values = {
            **pair.counts,
            "skew_ms": skew.mean_ns * 1e-6,
            "max_skew_ms": skew.max_ns * 1e-6,
            "skew_drift_ms": skew.drift_ns * 1e-6,
            "exposure_skew_ms": skew.exposure_ns * 1e-6,
            "tolerance_ms": pair.tolerance_ms,
        }
        state = "synchronised"
        if skew.exposure_ns:
            state = "not synchronised: the motion between the exposures is corrected"
        return DiagnosticStatus.of(status_names.PAIRING, WARN if fault else OK, fault or state, values)

    def _pairing_fault(self, pair: Synchronise) -> str:
        """Return the fault that explains all others first; empty without a fault."""
        rate_hz, broken_hz = (self._rate_hz(name, pair.counts[name]) for name in ("pairs", "broken"))
        missing = [name for name in self._sources.cameras if self._age_s(pair.newest_ns[name]) > TIMEOUT_S]
        if missing:
            return f"no images of the {' and the '.join(missing)} camera"
        if broken_hz > 0:
            return f"images cannot be decoded; the first: {pair.fault}"
        if pair.frozen:
            return (
                f"the images of the {' and the '.join(pair.frozen)} camera are frozen: all pixels are as before; "
                "check the camera and its driver"
            )
        if rate_hz == 0:
            return "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them"
        if pair.has_fixed_tolerance and abs(pair.skew.drift_ns) > MAX_SKEW_DRIFT_NS:
            return "the cameras drift apart in time: synchronise them"
        return ""

    def _cameras(self) -> Iterable[DiagnosticStatus]:
        for name, state in self._sources.cameras.items():
            newest_ns = self._sources.pair.newest_ns[name]
            age_s = self._age_s(newest_ns) if newest_ns else math.nan
            values = {"mode": state.mode, Key.RATE_HZ: self._rate_hz(f"{name} frames", state.frames), Key.AGE_S: age_s}
            values |= {key: getattr(state, key) for key in _CAMERA_COUNTERS}
            level, message = OK, str(state.status)
            if state.status == "lost":
                level, message = ERROR, state.problem
            elif state.status == "streaming" and not age_s <= TIMEOUT_S:
                level, message = ERROR, "no new image"
            yield DiagnosticStatus.of(status_names.camera_name(name), level, message, values)

    def _stage(self, stage: StageStats) -> DiagnosticStatus:
        return stage_status(stage, self._rate_hz(stage.name, stage.processed))


def _wheels(controller: ControllerStatistics, commands: CommandReceiver | None) -> DiagnosticStatus:
    state = controller.state  # read once, for another thread replaces it
    # 1. Counters, and times.
    values: dict[str, object] = {key: getattr(state, key) for key in _WHEEL_COUNTERS}
    values |= _by_reason(status_names.STOPPED_PREFIX, state.stops)
    values |= _by_reason(status_names.IGNORED_PREFIX, state.refused)
    if commands is not None:
        values |= {Key.COMMANDS: commands.accepted, Key.STOPS: commands.stops}
        values |= {Key.COMMAND_REFUSAL: commands.refusal}
        values |= _by_reason(status_names.REFUSED_PREFIX, commands.refused)
    late = controller.lateness
    values |= _times(status_names.CAPTURE_TO_WHEEL, controller.to_wheel) | _times(status_names.TICK_LATE, late)
    # 2. Arming, the source of the commands, obstacles, and what to do.
    values |= {
        time_key(status_names.TICK_LATE, "p999"): 1e3 * late.p(0.999),
        Key.ARMED: int(state.armed),
        Key.DISARMED_BY: state.disarmed_by,
        Key.REMEDY: remedy(state.obstacle) if state.blocked else REMEDY if state.needs_request else "",
        Key.ARM_REFUSAL: state.arm_answer.refusal,
        Key.SOURCE: state.source,
        Key.OBSTACLE: state.obstacle,
        Key.OBSTACLE_STOPS: state.obstacle_stops,
        Key.PROBLEM: state.problem,
        Key.MEASURED: state.measured,
        "battery_v": state.battery_v,
    }
    # 3. Whether the wheels turn, and why not.
    slow, reason = state.slowed_by or state.obstacle, state.reason
    message = reason or (f"driving slowly: {slow}" if slow else "driving")
    if not reason and state.blocked:
        message = f"stopped: {state.obstacle}"
    if reason == AWAITED:
        message = f"{AWAITED}: {state.problem}"
    if reason == NOT_ARMED:
        reason = state.disarmed_by
        message = reason if reason == STARTED else f"not armed: {reason}"
    is_slowed = not reason and bool(slow)
    level = WARN if is_slowed or reason not in NO_FAULTS else OK
    boots = state.reason == AWAITED and not state.overdue
    if not boots and (state.reason == FAILED or state.failed or state.fault):
        level = ERROR
    return DiagnosticStatus.of(status_names.WHEELS, level, message, values)


def _by_reason(prefix: str, counts: Mapping[str, int]) -> dict[str, object]:
    """Return counts by reason, of a copy: other threads add to them."""
    return {f"{prefix}{reason}": count for reason, count in dict(counts).items()}


def stage_status(stage: StageStats, rate_hz: float = math.nan) -> DiagnosticStatus:
    """Return the entry of a stage: work is the time for a message."""
    values = {
        Key.RATE_HZ: rate_hz,
        Key.PROCESSED: stage.processed,
        Key.MISSED if stage.is_ticker else Key.DROPPED: stage.dropped,
        **_times(status_names.WORK, stage.wall),
    }
    return DiagnosticStatus.of(status_names.stage_name(stage.name), OK, "", values)


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
    return DiagnosticStatus.of(status_names.SUMMARY, OK, "the run has ended", values)


def _times(name: str, histogram: Histogram) -> dict[str, float]:
    """Return median, 99th percentile and maximum in ms; nothing before the first measurement."""
    if not histogram.count:
        return {}
    found = zip(("p50", "p99", "max"), (*histogram.quantiles(0.5, 0.99), histogram.max_s), strict=True)
    return {time_key(name, statistic): 1e3 * value_s for statistic, value_s in found}


class Latency:
    """A sink of poses; `to_pose` holds the latencies [s]."""

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """clock_ns: the clock of the poses' stamps."""
        self._clock_ns = clock_ns
        self.to_pose = Histogram()

    def process(self, odometry: OdometryUpdate) -> None:
        """Add the latency of a pose."""
        self.to_pose.add((self._clock_ns() - odometry.stamp_ns) * 1e-9)
