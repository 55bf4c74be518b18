"""The numbers of the parts of a live daemon, and in words what is wrong (`omnid.transport.status_names`)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera
from omnid.controller.link import ControllerStatistics
from omnid.core.control.arming import STARTED
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.safety_rules import ASKED, AWAITED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.rig.rig_health import VIEWS, RigHealth
from omnid.core.stereo.tiles import SIDES
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.telemetry import StageStats, Telemetry
from omnid.messages import OdometryUpdate
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.commands import CommandReceiver
from omnid.transport.status_names import NOTABLE_SHARE, TIMEOUT_S, Key, Stats, by_reason, entry, times


class StatusCollector:
    """Makes the entries of all parts of a live run, with rates since the call before."""

    def __init__(
        self,
        telemetry: Telemetry,
        cameras: Mapping[Camera, CameraState],
        pair: Synchronise,
        statistics: RunStatistics,
        parts: Mapping[str, Callable[[], Stats]],
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """parts: numbers of the other parts, by their names. clock_ns: the clock of the stamps of images and poses."""
        self._telemetry, self._cameras, self._pair, self._statistics = telemetry, cameras, pair, statistics
        self._parts, self._clock_ns = parts, clock_ns
        self._before: dict[str, int] = {}  # counts of the last report
        self._before_s, self._span_s = time.monotonic(), math.nan

    def __call__(self) -> list[DiagnosticStatus]:
        """Return one entry for each part."""
        now_s = time.monotonic()
        self._span_s, self._before_s = now_s - self._before_s, now_s
        found: dict[str, Stats] = {status_names.ODOMETRY: self._odometry(), status_names.PAIRING: self._pairing()}
        found |= {f"{status_names.PREFIX}{name} camera": self._camera(name) for name in self._cameras}
        found |= {name: stats() for name, stats in self._parts.items()}
        for stage in self._telemetry.stages:
            rate_hz = self._rate_hz(stage.name, stage.processed)
            found[status_names.stage_name(stage.name)] = stage_stats(stage, rate_hz)
        return [entry(name, stats) for name, stats in found.items()]

    def _rate_hz(self, name: str, count: int) -> float:
        """Return by how much the counter of that name has grown per second since the last report."""
        before, self._before[name] = self._before.get(name, 0), count
        return (count - before) / self._span_s if self._span_s > 0 else math.nan

    def _age_s(self, stamp_ns: int) -> float:
        return (self._clock_ns() - stamp_ns) * S_PER_NS if stamp_ns else math.nan

    def _odometry(self) -> Stats:
        newest = self._statistics.newest
        if newest is None:
            return {"_stale": "no pose yet"}
        state, fault = newest.state, newest.image_fault
        if newest.light.is_too_dark and state != TrackingState.LOST:
            fault = "it is too dark"
        of_tracking = "_warning" if fault else "_words"
        severity = {TrackingState.LOST: "_error", TrackingState.TRACKING: of_tracking}.get(state, "_warning")
        age_s = self._age_s(newest.stamp_ns)
        return {
            Key.RATE_HZ: self._rate_hz("poses", self._statistics.poses),
            Key.AGE_S: age_s,
            Key.INLIERS: newest.inliers,
            Key.TRACKED: newest.tracks,
            Key.RUN: status_names.RUN_ID,
            Key.RESETS: newest.reset_counter,
            "length_m": self._statistics.length_m,
            "level_grey": newest.light.level_grey,
            "contrast_to_noise": newest.light.contrast_to_noise,
            **times(status_names.CAPTURE_TO_POSE, self._statistics.to_pose),
            **({"_stale": "no new pose"} if age_s > TIMEOUT_S else {severity: f"{state}: {fault}" if fault else state}),
        }

    def _pairing(self) -> Stats:
        pair, images = self._pair, self._telemetry.of("pair")
        stats: dict[str, Any] = pair.stats()
        missing = [name for name, stamp_ns in pair.newest_ns.items() if not self._age_s(stamp_ns) <= TIMEOUT_S]
        pairs_hz, broken_hz = (self._rate_hz(name, pair.counts[name]) for name in ("pairs", "broken"))
        taken_hz, dropped_hz = (
            self._rate_hz(f"pair {name}", getattr(images, name)) for name in ("processed", "dropped")
        )
        frozen = stats["_frozen"]
        warnings = {
            f"no images of the {' and the '.join(missing)} camera": missing,
            f"images cannot be decoded; the first: {stats['_fault']}": broken_hz > 0,
            f"the images of the {frozen} camera are frozen: check the camera and its driver": frozen,
            "too slow: the computer leaves images out; close other programs, or start omnid with --profile small": (
                dropped_hz > NOTABLE_SHARE * (taken_hz + dropped_hz)
            ),
            "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them": pairs_hz == 0,
        }
        return stats | {"_warning": next((words for words, is_so in warnings.items() if is_so), "")}

    def _camera(self, name: Camera) -> Stats:
        state, age_s = self._cameras[name], self._age_s(self._pair.newest_ns[name])
        counts = ("frames", Key.DROPS, Key.ERRORS, "restamped", Key.RESTARTS, Key.LOSSES, "reopens")
        is_late = state.status == "streaming" and not age_s <= TIMEOUT_S
        return {
            "mode": state.mode,
            Key.RATE_HZ: self._rate_hz(f"{name} frames", state.frames),
            Key.AGE_S: age_s,
            **{key: getattr(state, key) for key in counts},
            "_error": state.problem or "lost" if state.status == "lost" else "no new image" if is_late else "",
            "_words": state.status,
        }


def wheel_stats(controller: ControllerStatistics, commands: CommandReceiver) -> Stats:
    """Return the counters and times of the controller, whether the wheels turn, and why they do not."""
    state = controller.state  # read once, for another thread replaces it
    # 1. Why they stand or are slow; a controller that has failed is an error, one that is awaited is none.
    stop = state.disarmed_by if state.reason == NOT_ARMED else state.reason
    slow = "" if state.reason else state.slowed_by or state.obstacle
    words = stop or (f"driving slowly: {slow}" if slow else "driving")
    if state.reason == NOT_ARMED and stop != STARTED:
        words = f"not armed: {stop}"
    elif stop == AWAITED:
        words = f"{stop}: {state.problem}"
    elif not stop and state.blocked:
        words = f"stopped: {state.obstacle}"
    has_failed = state.reason != AWAITED and (state.reason == FAILED or state.failed or state.fault)
    is_unwanted = slow or stop not in ("", IDLE, ASKED, COMMAND_STALE, STARTED)
    severity = "_error" if has_failed else "_warning" if is_unwanted else "_words"
    # 2. The numbers.
    counts = ("sent", "late", Key.ERRORS, Key.EXPIRIES, "fault", "obstacle", "problem", "measured", "battery_v")
    arm = "send cmd/arm: `omnid arm`" if state.needs_request else ""
    return {
        **{key: getattr(state, key) for key in counts},
        **by_reason(status_names.STOPPED_PREFIX, state.stops),
        **by_reason(status_names.IGNORED_PREFIX, state.refused),
        "commands": commands.wheels.accepted,
        "stops": commands.stops,
        "command_refusal": commands.wheels.refusal,  # why the newest refused command was refused
        **by_reason(status_names.REFUSED_PREFIX, commands.wheels.refused),
        **times(status_names.TICK_LATE, controller.lateness),
        Key.ARMED: int(state.armed),
        Key.DISARMED_BY: state.disarmed_by,
        Key.REMEDY: remedy(state.obstacle) if state.blocked else arm,
        "arm_refusal": state.arm_answer.refusal,  # of the newest request to arm; empty: it was accepted
        Key.SOURCE: state.source,
        severity: words,
    }


def stage_stats(stage: StageStats, rate_hz: float = math.nan) -> Stats:
    """Return the numbers of a stage: work is the time for a message."""
    lost = Key.MISSED if stage.is_ticker else Key.DROPPED
    work = times(status_names.WORK, stage.wall)
    return {Key.RATE_HZ: rate_hz, Key.PROCESSED: stage.processed, lost: stage.dropped, **work}


def rig_stats(health: RigHealth) -> Stats:
    """Return the state of the rig, and the evidence of the newest finding."""
    stats = {Key.STATE: health.state, "views": len(health.views), "needed_views": VIEWS}
    stats["_error" if health.state.is_contradicted else "_warning"] = health.warning
    if (found := health.finding) is not None:
        stats |= {name: getattr(found, name) for name in ("turn_deg", "left_px", "matches", "tried")}
    return stats


def image_stats(newest: OdometryUpdate | None) -> Stats:
    """Return which cameras show parts that are frozen or blind in the newest pair."""
    if newest is None:
        return {"_stale": "no pose yet"}
    tiles, words = newest.depth.panoramas.tiles, []
    for side in SIDES:
        columns = tiles.columns.get(side, np.zeros(0, bool))
        if columns.any():
            where = "all around" if columns.all() else "in a part of its view"
            words.append(f"the {side} camera is {'frozen' if tiles.dead[side].any() else 'blind'} {where}")
    return {"_error": "; ".join(words)}
