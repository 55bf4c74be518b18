"""Status of a live daemon as diagnostic entries: odometry, pairing, cameras, wheels and stages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Final, NamedTuple

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera
from omnid.controller.statistics import ControllerState, ControllerStatistics
from omnid.core.control.arming import STARTED
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.safety_rules import ASKED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
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
EXPECTED_STOPS: Final = ("", IDLE, ASKED, COMMAND_STALE)  # reasons for a stop that are no fault
REMEDY: Final = "send cmd/arm: `omnid arm`"
LEVELS: Final = {TrackingState.TRACKING: OK, TrackingState.DEGRADED: WARN, TrackingState.LOST: ERROR}
_CAMERA_COUNTERS: Final = ("frames", Key.DROPS, Key.ERRORS, "restamped", Key.RESTARTS, Key.LOSSES, "reopens")
_WHEEL_COUNTERS: Final = ("sent", "late", Key.ERRORS, Key.EXPIRIES, "fault", "lost_reports", "slowed")


class Rates:
    """Counts per second since the previous report."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}
        self._before_s = time.monotonic()
        self._span_s = math.nan

    def begin(self) -> None:
        """Begin a new report."""
        now_s = time.monotonic()
        self._span_s, self._before_s = now_s - self._before_s, now_s

    def __call__(self, name: str, count: int) -> float:
        """Return by how much the counter of that name has grown per second."""
        before, self._before[name] = self._before.get(name, 0), count
        return (count - before) / self._span_s if self._span_s > 0 else math.nan


class StatusSources(NamedTuple):
    """The parts of a live run that the report is made of."""

    telemetry: Telemetry
    cameras: Mapping[Camera, CameraState]
    pair: Synchronise
    statistics: RunStatistics
    to_pose: Histogram  # s, from the capture of images to their pose
    controller: ControllerStatistics | None
    commands: CommandReceiver | None
    tickers: frozenset[str]  # stages whose `dropped` are missed deadlines
    others: tuple[Callable[[], DiagnosticStatus], ...] = ()  # parts that make their own entries
    clock_ns: Callable[[], int] = time.monotonic_ns  # the clock of the stamps of images and poses


class StatusCollector:
    """Makes the entries of all parts."""

    def __init__(self, sources: StatusSources) -> None:
        self._sources = sources
        self._rates = Rates()

    def __call__(self) -> list[DiagnosticStatus]:
        """Return one entry for each part."""
        self._rates.begin()
        sources = self._sources
        entries = [self._odometry(), self._pairing(), *self._cameras()]
        if sources.controller is not None:
            entries.append(self._wheels(sources.controller, sources.commands))
        entries += [status() for status in sources.others]
        return entries + [self._stage(stage) for stage in sources.telemetry.stages]

    def _odometry(self) -> DiagnosticStatus:
        statistics, newest = self._sources.statistics, self._sources.statistics.newest
        if newest is None:
            return DiagnosticStatus(status_names.ODOMETRY, STALE, "no pose yet", {})
        age_s = (self._sources.clock_ns() - newest.stamp_ns) * 1e-9
        values = {
            Key.RATE_HZ: f"{self._rates('poses', statistics.poses):.1f}",
            Key.AGE_S: f"{age_s:.3f}",
            Key.INLIERS: str(newest.inliers),
            Key.TRACKED: str(newest.tracks),
            Key.RESETS: str(newest.reset_counter),
            Key.LENGTH_M: f"{statistics.length_m:.2f}",
            **_times(status_names.CAPTURE_TO_POSE, self._sources.to_pose),
        }
        if age_s > TIMEOUT_S:
            return DiagnosticStatus(status_names.ODOMETRY, STALE, "no new pose", values)
        if math.isfinite(newest.light.level_grey):
            values |= {
                "level_grey": f"{newest.light.level_grey:.0f}",
                "contrast_to_noise": f"{newest.light.contrast_to_noise:.1f}",
            }
        if newest.light.is_too_dark and newest.state != TrackingState.LOST:
            return DiagnosticStatus(status_names.ODOMETRY, WARN, f"{newest.state}: it is too dark", values)
        return DiagnosticStatus(status_names.ODOMETRY, LEVELS[newest.state], newest.state, values)

    def _pairing(self) -> DiagnosticStatus:
        pair = self._sources.pair
        skew, counts = pair.skew, pair.counts
        fault = self._pairing_fault(pair)
        values = {name: str(count) for name, count in counts.items()} | {
            "skew_ms": f"{skew.mean_ns * 1e-6:.3f}",
            "max_skew_ms": f"{skew.max_ns * 1e-6:.3f}",
            "skew_drift_ms": f"{skew.drift_ns * 1e-6:.3f}",
            "exposure_skew_ms": f"{skew.exposure_ns * 1e-6:.3f}",
            "tolerance_ms": f"{pair.tolerance_ms:.3f}",
        }
        state = "synchronised"
        if skew.exposure_ns:
            state = "not synchronised: the motion between the exposures is corrected"
        return DiagnosticStatus(status_names.PAIRING, WARN if fault else OK, fault or state, values)

    def _pairing_fault(self, pair: Synchronise) -> str:
        """Return the fault that explains all others first; empty without a fault."""
        rate_hz, broken_hz = self._rates("pairs", pair.counts["pairs"]), self._rates("broken", pair.counts["broken"])
        missing = [name for name in self._sources.cameras if self._image_age_s(name) > TIMEOUT_S]
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

    def _image_age_s(self, camera: Camera) -> float:
        """Return the age of the camera's newest image; inf before the first."""
        newest_ns = self._sources.pair.newest_ns[camera]
        return (self._sources.clock_ns() - newest_ns) * 1e-9 if newest_ns else math.inf

    def _cameras(self) -> Iterable[DiagnosticStatus]:
        for name, state in self._sources.cameras.items():
            rate_hz, age_s = self._rates(f"{name} frames", state.frames), self._image_age_s(name)
            values = {"mode": state.mode, Key.RATE_HZ: f"{rate_hz:.1f}"}
            if math.isfinite(age_s):
                values[Key.AGE_S] = f"{age_s:.3f}"
            values |= {key: str(getattr(state, key)) for key in _CAMERA_COUNTERS}
            level, message = OK, str(state.status)
            if state.status == "lost":
                level, message = ERROR, state.problem
            elif state.status == "streaming" and age_s > TIMEOUT_S:
                level, message = ERROR, "no new image"
            yield DiagnosticStatus(status_names.camera_name(name), level, message, values)

    def _wheels(self, controller: ControllerStatistics, commands: CommandReceiver | None) -> DiagnosticStatus:
        state = controller.state  # read once, for another thread replaces it
        values = {key: str(getattr(state, key)) for key in _WHEEL_COUNTERS}
        values |= {f"{status_names.STOPPED_PREFIX}{reason}": str(count) for reason, count in state.stops.items()}
        values |= _times(status_names.CAPTURE_TO_WHEEL, controller.to_wheel)
        values |= _times(status_names.TICK_LATE, controller.lateness)
        values[time_key(status_names.TICK_LATE, "p999")] = f"{1e3 * controller.lateness.p(0.999):.2f}"
        values |= {f"{status_names.IGNORED_PREFIX}{reason}": str(count) for reason, count in state.refused.items()}
        values |= _arming(state) | _obstacle(state)
        if commands is not None:
            refused = dict(commands.refused)  # a copy, for another thread adds to it
            values |= {Key.COMMANDS: str(commands.accepted), Key.STOPS: str(commands.stops)}
            values |= {f"{status_names.REFUSED_PREFIX}{reason}": str(count) for reason, count in refused.items()}
        if math.isfinite(state.battery_v):
            values["battery_v"] = f"{state.battery_v:.2f}"
        message = state.reason or _driving(state)
        if state.reason == NOT_ARMED:
            message = state.disarmed_by if state.disarmed_by == STARTED else f"not armed: {state.disarmed_by}"
        return DiagnosticStatus(status_names.WHEELS, self._wheels_level(controller), message, values)

    @staticmethod
    def _wheels_level(controller: ControllerStatistics) -> int:
        state = controller.state
        if state.reason == FAILED or state.failed or state.fault:
            return ERROR
        reason = state.disarmed_by if state.reason == NOT_ARMED else state.reason
        if not reason and (state.slowed_by or state.obstacle):
            return WARN
        return OK if reason in (*EXPECTED_STOPS, STARTED) else WARN

    def _stage(self, stage: StageStats) -> DiagnosticStatus:
        lost = Key.MISSED if stage.name in self._sources.tickers else Key.DROPPED
        return stage_status(stage, lost, rate_hz=self._rates(stage.name, stage.processed))


def stage_status(stage: StageStats, lost: Key = Key.DROPPED, rate_hz: float | None = None) -> DiagnosticStatus:
    """Return the entry of a stage: work is the time for a message, cpu the processor time in it.

    lost: key of the counter of lost messages, or of missed deadlines.
    """
    values = {} if rate_hz is None else {str(Key.RATE_HZ): f"{rate_hz:.1f}"}
    values |= {
        Key.PROCESSED: str(stage.processed),
        lost: str(stage.dropped),
        **_times(status_names.WORK, stage.wall),
        **_times(status_names.CPU, stage.cpu),
    }
    return DiagnosticStatus(status_names.stage_name(stage.name), OK, "", values)


def summary_status(counters: RunCounters) -> DiagnosticStatus:
    """Return the entry of a finished replay: its counters, one number per key."""
    values = {
        "pairs": str(counters.pairs),
        "poses": str(counters.poses),
        str(Key.LENGTH_M): f"{counters.length_m:.4f}",
        **{f"poses_{state}": str(count) for state, count in counters.states.items()},
        Key.RESETS: str(counters.resets),
    }
    for prefix, counts in (
        ("dropped", counters.drops),
        ("map", counters.map),
        ("places", counters.places),
        ("motor", counters.motor),
    ):
        values |= {f"{prefix}_{name}": str(count) for name, count in counts.items()}
    return DiagnosticStatus(status_names.SUMMARY, OK, "the run has ended", values)


def _arming(state: ControllerState) -> dict[str, str]:
    """Return the values about arming and about the source of the commands, without those that are empty."""
    values = {
        Key.ARMED: str(int(state.armed)),
        Key.DISARMED_BY: state.disarmed_by,
        Key.REMEDY: REMEDY if state.needs_request else "",
        Key.ARM_REFUSAL: state.arm_answer.refusal,
        Key.SOURCE: state.source,
    }
    return {key: text for key, text in values.items() if text}


def _driving(state: ControllerState) -> str:
    """Return how the base drives while no rule stops it."""
    if state.blocked:
        return f"stopped: {state.obstacle}"
    slow = state.slowed_by or state.obstacle
    return f"driving slowly: {slow}" if slow else "driving"


def _obstacle(state: ControllerState) -> dict[str, str]:
    """Return the values about the collision monitor."""
    values: dict[str, str] = {Key.OBSTACLE_STOPS: str(state.obstacle_stops)}
    if state.obstacle:
        values[Key.OBSTACLE] = state.obstacle
    if state.blocked:
        values[Key.REMEDY] = remedy(state.obstacle)
    return values


def _times(name: str, histogram: Histogram) -> dict[str, str]:
    """Return median, 99th percentile and maximum in ms; nothing before the first measurement."""
    if not histogram.count:
        return {}
    found = zip(("p50", "p99", "max"), (*histogram.quantiles(0.5, 0.99), histogram.max_s), strict=True)
    return {time_key(name, statistic): f"{1e3 * value_s:.2f}" for statistic, value_s in found}


class StatusTick:
    """Action of a ticker: makes a report and passes it to the consumers."""

    def __init__(
        self, report: Callable[[], list[DiagnosticStatus]], *consumers: Callable[[list[DiagnosticStatus]], None]
    ) -> None:
        self._report, self._consumers = report, consumers

    def __call__(self) -> None:
        """Make and pass one report."""
        statuses = self._report()
        for consume in self._consumers:
            consume(statuses)


class Latency:
    """A sink of poses; `to_pose` holds the latencies [s]."""

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """clock_ns: the clock of the poses' stamps."""
        self._clock_ns = clock_ns
        self.to_pose = Histogram()

    def process(self, odometry: OdometryUpdate) -> None:
        """Add the latency of a pose."""
        self.to_pose.add((self._clock_ns() - odometry.stamp_ns) * 1e-9)
