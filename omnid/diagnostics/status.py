"""The state of a live daemon as diagnostics: stages, cameras, pairing, odometry, wheels; rates, drops, latencies."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera
from omnid.controller.statistics import ControllerStatistics
from omnid.core.control.safety_rules import ASKED, COMMAND_STALE, FAILED, IDLE
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.stages.synchronise import Synchronise
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus
from omnid.transport.commands import CommandReceiver

WANDERED_NS = 3_000_000  # of the skew of the cameras: their clocks do not run alike
SILENT_S = 1.0  # a camera without a image, or an odometry without a pose, for longer is told
CALM = ("", IDLE, ASKED, COMMAND_STALE)  # why wheels stand that are as they should be
STATES = {"tracking": OK, "degraded": WARN, "lost": ERROR}


class Rates:
    """Counts per second since the last time of asking."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}
        self._before_s = time.monotonic()
        self._span_s = math.nan

    def begin(self) -> None:
        """A new time of asking."""
        now_s = time.monotonic()
        self._span_s, self._before_s = now_s - self._before_s, now_s

    def __call__(self, name: str, count: int) -> float:
        """How much the count of that name has grown per second."""
        before, self._before[name] = self._before.get(name, 0), count
        return (count - before) / self._span_s if self._span_s > 0 else math.nan


class StatusSources(NamedTuple):
    """What a live run is asked about."""

    telemetry: Telemetry
    cameras: Mapping[Camera, CameraState]
    pair: Synchronise
    tally: RunStatistics
    to_pose: Histogram
    controller: ControllerStatistics | None
    commands: CommandReceiver | None
    tickers: frozenset[str]  # their `dropped` are missed deadlines
    others: tuple[Callable[[], DiagnosticStatus], ...] = ()  # parts that speak for themselves


class StatusReport:
    """Asks everybody and says it in the words of diagnostic_msgs."""

    def __init__(self, watched: StatusSources) -> None:
        self._watched = watched
        self._rates = Rates()

    def __call__(self) -> list[DiagnosticStatus]:
        """One status for each part."""
        self._rates.begin()
        w = self._watched
        wheels = [] if w.controller is None else [self._wheels(w.controller, w.commands)]
        others = [status() for status in w.others]
        return [self._odometry(), self._pairing(), *self._cameras(), *wheels, *others,
                *map(self._stage, w.telemetry.stages)]

    def _odometry(self) -> DiagnosticStatus:
        tally, newest = self._watched.tally, self._watched.tally.newest
        if newest is None:
            return DiagnosticStatus("omnid: odometry", STALE, "no pose yet", {})
        age_s = (time.monotonic_ns() - newest.stamp_ns) * 1e-9
        stale = age_s > SILENT_S
        values = {"rate_hz": f"{self._rates('poses', tally.poses):.1f}", "age_s": f"{age_s:.3f}",
                  "landmarks": f"{newest.inliers} of {newest.tracks}", "resets": str(newest.reset_counter),
                  "length_m": f"{tally.length_m:.2f}", **_times("capture_to_pose", self._watched.to_pose)}
        said = f"no pose for {age_s:.1f} s" if stale else newest.state
        return DiagnosticStatus("omnid: odometry", STALE if stale else STATES[newest.state], said, values)

    def _pairing(self) -> DiagnosticStatus:
        pair = self._watched.pair
        skew, counts = pair.skew, pair.counts
        fault = self._fault(pair)
        values = {name: str(count) for name, count in counts.items()} | {
            "skew_ms": f"{skew.mean_ns * 1e-6:.3f}", "most_skew_ms": f"{skew.max_ns * 1e-6:.3f}",
            "wandered_ms": f"{skew.drift_ns * 1e-6:.3f}"}
        return DiagnosticStatus("omnid: pairing", WARN if fault else OK, fault or "in step", values)

    def _fault(self, pair: Synchronise) -> str:
        """What is wrong with the pairing, in the order of what explains the rest; empty where it goes well."""
        rate_hz, broken_hz = self._rates("pairs", pair.counts["pairs"]), self._rates("broken", pair.counts["broken"])
        silent = [name for name in self._watched.cameras if self._silent_s(name) > SILENT_S]
        if silent:
            return f"no images of the {' and the '.join(silent)} camera"
        if broken_hz > 0:
            return f"images that cannot be decoded, the first: {pair.fault}"
        if rate_hz == 0:
            return "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them"
        return "the cameras drift apart in time: synchronise them" if abs(pair.skew.drift_ns) > WANDERED_NS else ""

    def _silent_s(self, camera: Camera) -> float:
        """How long ago the camera's newest image was taken; inf before the first."""
        newest_ns = self._watched.pair.newest_ns[camera]
        return (time.monotonic_ns() - newest_ns) * 1e-9 if newest_ns else math.inf

    def _cameras(self) -> Iterable[DiagnosticStatus]:
        for name, state in self._watched.cameras.items():
            counts = {key: str(getattr(state, key)) for key in
                      ("frames", "drops", "errors", "restamped", "restarts", "losses", "reopens")}
            rate = f"{self._rates(f'{name} frames', state.frames):.1f}"
            silent_s = self._silent_s(name)
            said = state.problem if state.status == "lost" else state.status
            if state.status == "streaming" and silent_s > SILENT_S:
                said = f"no image for {silent_s:.1f} s"
            yield DiagnosticStatus(f"omnid: {name} camera", OK if said == state.status else ERROR, said,
                         {"mode": state.mode, "rate_hz": rate, **counts})

    def _wheels(self, controller: ControllerStatistics, commands: CommandReceiver | None) -> DiagnosticStatus:
        state = controller.state  # once, for another thread replaces it
        counts = ("sent", "late", "errors", "expiries", "fault", "lost_reports")
        values = {name: str(getattr(state, name)) for name in counts}
        values |= {f"stopped, {why}": str(count) for why, count in state.stops.items()}
        values |= _times("capture_to_wheel", controller.to_wheel) | _times("tick_late", controller.lateness)
        values["tick_late_p999_ms"] = f"{1e3 * controller.lateness.p(0.999):.2f}"
        if commands is not None:
            values |= {"commands": str(commands.accepted), "stops": str(commands.stops)}
            values |= {f"refused, {why}": str(count) for why, count in dict(commands.refused).items()}
        reason, bad = state.reason, state.reason == FAILED or state.failed or state.fault
        return DiagnosticStatus(
            "omnid: wheels", ERROR if bad else OK if reason in CALM else WARN, reason or "driving", values
        )

    def _stage(self, stage: StageStats) -> DiagnosticStatus:
        missed = "missed" if stage.name in self._watched.tickers else "dropped"
        return stage_status(stage, missed, rate_hz=f"{self._rates(stage.name, stage.processed):.1f}")


def stage_status(stage: StageStats, dropped: str = "dropped", **more: str) -> DiagnosticStatus:
    """What the counters of a stage say: work is what a message took, cpu what of it was its own; dropped: the name of
    what is lost there.
    """
    values = {**more, "processed": str(stage.processed), dropped: str(stage.dropped), **_times("work", stage.wall),
              **_times("cpu", stage.cpu)}
    return DiagnosticStatus(f"omnid: stage {stage.name}", OK, "", values)


def _times(name: str, histogram: Histogram) -> dict[str, str]:
    """Median, 99th percentile and maximum in ms, once there is one."""
    if not histogram.count:
        return {}
    found = (("p50", histogram.p(0.5)), ("p99", histogram.p(0.99)), ("max", histogram.max_s))
    return {f"{name}_{which}_ms": f"{1e3 * value_s:.2f}" for which, value_s in found}


class StatusTick:
    """The action of a ticker: makes the report and hands it to whoever wants it."""

    def __init__(self, report: StatusReport, *wants: Callable[[list[DiagnosticStatus]], None]) -> None:
        self._report, self._wants = report, wants

    def __call__(self) -> None:
        """One report."""
        statuses = self._report()
        for want in self._wants:
            want(statuses)
