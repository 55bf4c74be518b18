"""Counters of a run, their summary in words, its progress, and warnings about the input that it makes apparent."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.frame import CAMERAS
from omnid.config import Config
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.rig.rig_health import RigHealth
from omnid.core.stereo.tiles import SIDES, Side
from omnid.engine.logging_setup import HANDLER
from omnid.engine.robot_clock import RobotClock
from omnid.engine.telemetry import Histogram
from omnid.messages import OdometryUpdate
from omnid.stages.synchronise import FROZEN_IMAGES, Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import NOTABLE_SHARE


class RunStatistics:
    """A sink that counts poses; other threads may read its attributes meanwhile."""

    def __init__(self, clock: RobotClock | None = None) -> None:
        """clock: of the stamps of a live run, which measures how long its poses take; None: the run is over a log."""
        self.to_pose, self._clock = Histogram(), clock  # from the stamp of a pair to its pose [s]
        self.poses = 0
        self.length_m = 0.0
        self.states: Counter[str] = Counter()
        self.resets = 0
        self.dark = 0  # pairs that were too dark
        self.lost_parts: Counter[Side] = Counter()  # pairs in which a part of a camera's image was frozen or blind
        self.newest: OdometryUpdate | None = None
        self._position: NDArray[np.float64] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Count a pose."""
        if self._clock is not None:
            self.to_pose.add((self._clock.monotonic_ns() - odometry.stamp_ns) * S_PER_NS)
        # 1. The way.
        position = odometry.T_odom_rig[:3, 3]
        if self._position is not None:
            self.length_m += float(np.linalg.norm(position - self._position))
        self._position, self.newest = position, odometry
        # 2. States of poses and images.
        self.states[odometry.state] += 1
        self.dark += odometry.light.is_too_dark
        columns = odometry.depth.panoramas.tiles.columns
        self.lost_parts.update(side for side, found in columns.items() if found.any())
        self.resets = odometry.reset_counter
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
    map: Mapping[str, int] = field(default_factory=dict)  # voxels and points; empty without a map
    places: Mapping[str, int] = field(default_factory=dict)  # keyframes, loops, refusals; empty without a map of places
    motor: Mapping[str, int] = field(default_factory=dict)  # commands, errors, stops; empty without a motor
    loss: str = ""  # one line where more than a tenth of the pairs is missing

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
    possible, made = round(pairing.possible + read["broken"] / len(CAMERAS)), pairing.counts["pairs"]
    lost = possible - made
    return f"{lost} of {possible} pairs are missing: see what was lost" if lost > NOTABLE_SHARE * possible else ""


def summary_entries(counters: RunCounters, *, verbose: bool = False) -> dict[str, str]:
    """Return the counters as texts, by name: pairs and what was lost, last the length and the states.

    verbose: with counts of zero, and those of the map.
    """

    def listed(counts: Mapping[str, int], zeros: bool = True) -> str:
        return ", ".join(f"{name} {count}" for name, count in counts.items() if count or zeros)

    poses, resets, motor = counters.poses, counters.resets, counters.motor
    found = {
        "pairs": str(counters.pairs),
        "poses": str(poses),
        "lost": listed(counters.drops, verbose),
        "resets": str(resets) if resets or verbose else "",
        "map": listed(counters.map) if verbose else "",
        "places": listed(counters.places) if verbose else "",
        "motor": "{commands} commands sent, {errors} errors, {stops} stops".format_map(motor) if motor else "",
        "length": f"{counters.length_m:.4f} m",
        "states": ", ".join(f"{s} {n / (poses or 1):.1%}" for s, n in counters.states.items() if n or verbose),
    }
    return {name: text for name, text in found.items() if text or name == "states"}


def timing_table(timings: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Yield a line for each stage that has processed messages, below their titles."""
    yield f"{'stage':<17}{'n':>8}{'drops':>7}{'p50 ms':>9}{'p99 ms':>9}{'max ms':>9}"
    for stage, row in timings.items():
        if row["n"]:
            yield f"{stage:<17}{{n:>8}}{{drops:>7}}{{p50_ms:>9.2f}}{{p99_ms:>9.2f}}{{max_ms:>9.2f}}".format(**row)
    yield ""


class Progress:
    """Shows how far a run over a log is, in a line that a terminal keeps showing."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()

    def __call__(self, statistics: RunStatistics, expected: int | None, ended: bool) -> None:
        """Show the progress now; ended: remove it."""
        newest = statistics.newest
        if ended or newest is None:
            HANDLER.show("")
            return
        done, passed_s = newest.seq + 1, time.monotonic() - self._start_s
        share = f"{done}/{expected}" if expected else f"{done}"
        rate = done / max(1e-3, passed_s)
        HANDLER.show(f"{share} pairs, {rate:.1f} pairs/s, {statistics.length_m:.2f} m, {newest.state}")


def input_warnings(pairing: Synchronise, rig: RigHealth, statistics: RunStatistics, config: Config) -> Iterator[str]:
    """Yield one line for each problem of the input: of images and stamps, of the rig, and that odometry has met."""
    stats: dict[str, Any] = pairing.stats()
    poses, states, dark = statistics.poses, statistics.states, statistics.dark
    lost, degraded, notable = states[TrackingState.LOST], states[TrackingState.DEGRADED], NOTABLE_SHARE * poses
    unpaired = min(stats["unpaired_lower"], stats["unpaired_upper"])
    # 1. Images and their stamps.
    if stats["_fault"]:
        yield f"{stats['broken']} images could not be used; the first: {stats['_fault']}"
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
    # 3. Poses that are not sure.
    if lost + degraded > poses / 2:
        yield (
            f"the pose was lost in {lost} of {poses} pairs, degraded in {degraded}: is the rig that of these cameras, "
            "is --lower the lower one, are the images bright and sharp, is the robot slower than "
            f"odometry.limits.max_speed_mps = {config.odometry.limits.max_speed_mps:g}?"
        )
