"""Counters of a run, warnings about its input, and the status of the parts of a live run (`status_names`)."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera
from omnid.config import Config
from omnid.controller.link import ControllerStatistics
from omnid.core.control.arming import STARTED
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.safety_rules import ASKED, AWAITED, COMMAND_STALE, FAILED, IDLE, NOT_ARMED
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.rig.rig_health import RigHealth
from omnid.core.stereo.tiles import SIDES, Side
from omnid.engine.graph import Histogram, StageStats
from omnid.engine.logging_setup import HANDLER
from omnid.engine.robot_clock import RobotClock
from omnid.messages import OdometryUpdate
from omnid.stages.synchronise import FROZEN_IMAGES, Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.commands import CommandReceiver
from omnid.transport.status_names import NOTABLE_SHARE, TIMEOUT_S, Key, Stats, by_reason, entry, with_reason


class RunStatistics:
    """A sink that counts poses; other threads may read its attributes meanwhile."""

    def __init__(self, clock: RobotClock | None = None) -> None:
        """clock: of the stamps of a live run, which measures how long its poses take; None: the run is over a log."""
        self.latency, self._clock = Histogram(), clock  # from the stamp of a pair to its pose [s]
        self.poses = 0
        self.length_m = 0.0
        self.states: Counter[str] = Counter()
        self.dark_pairs = 0
        self.lost_parts: Counter[Side] = Counter()  # pairs in which a part of a camera's image was frozen or blind
        self.newest: OdometryUpdate | None = None
        self._position: NDArray[np.float64] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Count a pose."""
        if self._clock is not None:
            self.latency.add((self._clock.monotonic_ns() - odometry.stamp_ns) * S_PER_NS)
        # 1. The length of the path.
        position = odometry.T_odom_rig[:3, 3]
        if self._position is not None:
            self.length_m += float(np.linalg.norm(position - self._position))
        self._position, self.newest = position, odometry
        # 2. States of poses and images.
        self.states[odometry.state] += 1
        pair = odometry.depth.panoramas
        self.dark_pairs += pair.light.is_too_dark
        self.lost_parts.update(side for side, found in pair.tiles.columns.items() if found.any())
        self.poses += 1


@dataclass(frozen=True, slots=True)
class RunCounters:
    """Counts of a run over a log."""

    pairs: int  # of images
    poses: int
    length_m: float  # of the path
    states: Mapping[TrackingState, int]  # poses in each state
    resets: int  # gaps in the trajectory after which tracking began again
    drops: Mapping[str, int]  # messages lost, by reason; zeros too
    places: Mapping[str, int] = field(default_factory=dict)  # keyframes, loops, refusals; empty without a map of places
    loss: str = ""  # of pair_loss

    @property
    def no_pose(self) -> bool:
        """True if no pose was measured: there are none, or all are predictions."""
        return self.poses == self.states[TrackingState.LOST]


def pair_loss(pairing: Synchronise, read: Mapping[str, int]) -> str:
    """Return one line where more than a tenth of the pairs of a log is missing, or records of it are corrupt; else "".

    read: counts of its reader. Images of a faster camera that the other one has no partners for are no loss.
    """
    if read["broken_records"]:
        return "images may be missing: see what was lost"
    possible, made = round(pairing.possible + read["broken"] / len(CAMERAS)), pairing.stats()["pairs"]
    lost = possible - made
    return f"{lost} of {possible} pairs are missing: see what was lost" if lost > NOTABLE_SHARE * possible else ""


def summary_entries(counters: RunCounters, *, verbose: bool = False) -> dict[str, str]:
    """Return the counters as texts, by name: pairs and what was lost, last the length and the states.

    verbose: with counts of zero, and those of the map.
    """

    def listed(counts: Mapping[str, int], zeros: bool = True) -> str:
        return ", ".join(f"{name} {count}" for name, count in counts.items() if count or zeros)

    found = {
        "pairs": str(counters.pairs),
        "poses": str(counters.poses),
        "lost": listed(counters.drops, verbose),
        "resets": str(counters.resets) if counters.resets or verbose else "",
        "places": listed(counters.places) if verbose else "",
        "length": f"{counters.length_m:.4f} m",
        "states": ", ".join(f"{s} {n / (counters.poses or 1):.1%}" for s, n in counters.states.items() if n or verbose),
    }
    return {name: text for name, text in found.items() if text or name == "states"}


def timing_table(timings: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Yield a line for each stage that has processed messages, below their titles."""
    yield f"{'stage':<17}{'n':>8}{'drops':>7}{'p50 ms':>9}{'p99 ms':>9}{'max ms':>9}"
    for stage, row in timings.items():
        if row["n"]:
            yield f"{stage:<17}{{n:>8}}{{drops:>7}}{{p50_ms:>9.2f}}{{p99_ms:>9.2f}}{{max_ms:>9.2f}}".format(**row)
    yield ""


def show_progress(statistics: RunStatistics, expected: int | None, ended: bool) -> None:
    """Show how far a run over a log is, in a line that a terminal keeps showing; ended: remove it."""
    newest = statistics.newest
    if ended or newest is None:
        HANDLER.show("")
    else:
        HANDLER.show(f"{newest.seq + 1} of {expected or '?'} pairs, {statistics.length_m:.2f} m, {newest.state}")


def input_warnings(pairing: Synchronise, rig: RigHealth, statistics: RunStatistics, config: Config) -> Iterator[str]:
    """Yield one line for each problem of the input: of images and stamps, of the rig, and that odometry has met."""
    stats = pairing.stats()
    poses, states, dark = statistics.poses, statistics.states, statistics.dark_pairs
    lost, degraded, notable = states[TrackingState.LOST], states[TrackingState.DEGRADED], NOTABLE_SHARE * poses
    unpaired = min(stats["unpaired_lower"], stats["unpaired_upper"])
    # 1. Images and their stamps.
    if stats["_first_error"]:
        yield f"{stats['broken']} images could not be used; the first: {stats['_first_error']}"
    if not stats["pairs"] and not unpaired:
        yield "no pair of images: a camera has none that can be used"
    if unpaired > stats["pairs"]:
        yield (
            "most images of both cameras found no partner: their stamps are more than pair.tolerance_ms = "
            f"{stats['tolerance_ms']:g} apart: correct the clocks of the cameras, synchronise them, or increase it"
        )
    for camera in CAMERAS:
        if (repeated := stats[f"repeated_{camera}"]) >= FROZEN_IMAGES:
            yield (
                f"the {camera} camera was frozen: {repeated} of its images repeat earlier ones; their pairs are left "
                "out, unless pair.repeated_images = 'use', as for a simulator without noise"
            )
    # 2. The rig, the light, dead parts of images.
    if rig.warning:
        yield rig.warning
    if dark > notable:
        yield (
            f"it was too dark in {dark} of {poses} pairs: the images have more noise than contrast; more light, a "
            "longer exposure (cameras.exposure_us) or less gain"
        )
    for side in SIDES:
        if (parts := statistics.lost_parts[side]) > notable:
            yield (
                f"a part of the {side} camera's image was frozen, dark, saturated or blurred in {parts} of {poses} "
                "pairs: clean the mirror, check the camera and its driver"
            )
    # 3. Poses that are lost or degraded.
    if lost + degraded > poses / 2:
        yield (
            f"the pose was lost in {lost} of {poses} pairs, degraded in {degraded}: is the rig that of these cameras, "
            "is --lower the lower one, are the images bright and sharp, is the robot slower than "
            f"odometry.limits.max_speed_mps = {config.odometry.limits.max_speed_mps:g}?"
        )


class StatusCollector:
    """Makes the entries of all parts of a live run, with rates since the call before."""

    def __init__(
        self,
        stages: Mapping[str, StageStats],
        cameras: Mapping[Camera, CameraState],
        pair: Synchronise,
        statistics: RunStatistics,
        parts: Mapping[str, Callable[[], Stats]],
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """parts: numbers of the other parts, by their names. clock_ns: the clock of the stamps of images and poses."""
        self._stages, self._cameras, self._pair, self._statistics = stages, cameras, pair, statistics
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
        for name, stage in self._stages.items():
            found[f"{status_names.STAGE_PREFIX}{name}"] = {
                Key.RATE_HZ: self._rate_hz(name, stage.processed),
                Key.PROCESSED: stage.processed,
                Key.DROPPED: stage.dropped,
                **stage.wall.times_ms(status_names.WORK),  # for a message
            }
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
        if newest.depth.panoramas.light.is_too_dark and state != TrackingState.LOST:
            fault = "it is too dark"
        of_tracking = "_warning" if fault else "_ok"
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
            **self._statistics.latency.times_ms(status_names.CAPTURE_TO_POSE),
            **({"_stale": "no new pose"} if age_s > TIMEOUT_S else {severity: with_reason(state, fault)}),
        }

    def _pairing(self) -> Stats:
        pair, stage = self._pair, self._stages["pair"]
        stats = pair.stats()
        missing = [name for name, stamp_ns in pair.newest_ns.items() if not self._age_s(stamp_ns) <= TIMEOUT_S]
        pairs_hz, broken_hz, *unpaired_hz = (
            self._rate_hz(name, stats[name]) for name in ("pairs", "broken", "unpaired_lower", "unpaired_upper")
        )
        processed_hz, dropped_hz = (
            self._rate_hz(f"pair {name}", getattr(stage, name)) for name in ("processed", "dropped")
        )
        frozen = stats["_frozen"]
        warnings = {
            f"no images of the {' and the '.join(missing)} camera": missing,
            f"images cannot be decoded; the first: {stats['_first_error']}": broken_hz > 0,
            f"the images of the {frozen} camera are frozen: check the camera and its driver": frozen,
            "too slow: the computer leaves images out; close other programs, or start omnid with --profile small": (
                dropped_hz > NOTABLE_SHARE * (processed_hz + dropped_hz)
            ),
            "the cameras' images are further apart in time than pair.tolerance_ms: synchronise them": (
                pairs_hz == 0 and all(unpaired_hz)
            ),
        }
        return stats | {"_warning": next((words for words, applies in warnings.items() if applies), "")}

    def _camera(self, name: Camera) -> Stats:
        state, age_s = self._cameras[name], self._age_s(self._pair.newest_ns[name])
        counts = ("frames", Key.DROPS, Key.ERRORS, "restamped", Key.RESTARTS, Key.LOSSES, "reopens")
        error = (state.problem or "lost") if state.status == "lost" else ""
        if state.status == "streaming" and not age_s <= TIMEOUT_S:
            error = "no new image"
        return {
            "mode": state.mode,
            Key.RATE_HZ: self._rate_hz(f"{name} frames", state.frames),
            Key.AGE_S: age_s,
            **{key: getattr(state, key) for key in counts},
            "_error": error,
            "_ok": state.status,
        }


def wheel_stats(controller: ControllerStatistics, commands: CommandReceiver) -> Stats:
    """Return the counters and times of the controller, whether the wheels turn, and why they do not."""
    state = controller.state  # Read once, because another thread replaces it.
    # 1. Why the wheels are stopped or slow. A controller that has failed is an error, one that is awaited is not.
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
    severity = "_error" if has_failed else "_warning" if is_unwanted else "_ok"
    # 2. The numbers.
    counts = ("sent", "late", "missed", Key.ERRORS, Key.EXPIRIES, "fault", "obstacle", "problem")
    arm = "send cmd/arm: `omnid arm`" if state.needs_request else ""
    return {
        **{key: getattr(state, key) for key in (*counts, "measured", "battery_v")},
        **by_reason(status_names.STOPPED_PREFIX, state.stops),
        **by_reason(status_names.IGNORED_PREFIX, state.refused),
        "commands": commands.wheels.accepted,
        "stops": commands.stops,
        "command_refusal": commands.wheels.refusal,  # why the newest refused command was refused
        **by_reason(status_names.REFUSED_PREFIX, commands.wheels.refused),
        **controller.lateness.times_ms(status_names.TICK_LATE),
        Key.ARMED: int(state.armed),
        Key.DISARMED_BY: state.disarmed_by,
        Key.REMEDY: remedy(state.obstacle) if state.blocked else arm,
        "arm_refusal": state.arm_answer.refusal,  # of the newest request to arm; empty: it was accepted
        Key.SOURCE: state.source,
        severity: words,
    }


def rig_stats(health: RigHealth) -> Stats:
    """Return the state of the rig, and what contradicts it."""
    return {Key.STATE: health.state, "_error" if health.state.is_contradicted else "_warning": health.warning}


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
