"""Entries of the status that describe parts of a run: rig, floor, places, motion, images."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.nanoseconds import S_PER_NS
from omnid.core.obstacles.unwatched import Unwatched
from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, GYRO_OFFSET, TURN, WHEEL_OFFSET, MotionSensors
from omnid.core.rig.column_finding import RigState
from omnid.core.rig.rig_health import VIEWS, RigHealth
from omnid.core.stereo.tiles import SIDES, Side, TileStates
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.robot_clock import RobotClock
from omnid.stages.geometry import Geometry
from omnid.stages.motion_inbox import MotionInbox
from omnid.stages.obstacles import CameraFloor, Obstacles
from omnid.stages.odometry import OdometryStage
from omnid.stages.places import Places
from omnid.tracking_state import MapState
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus
from omnid.transport.commands import SensorReceiver
from omnid.transport.status_names import (
    CLOCK,
    FIXED_PERCENT,
    FLOOR,
    IMAGES,
    MOTION,
    PLACES,
    REFUSED_PREFIX,
    RIG,
    Key,
    lost_parts_key,
)

# Level and message of each state of the rig.
RIG_STATES: Final = MappingProxyType(
    {
        RigState.UNCHECKED: (OK, "not checked yet: the robot must drive past different places"),
        RigState.FITS: (OK, "fits"),
        RigState.DRIFTED: (
            WARN,
            "drifted: run omnid calibrate drive --only check on a recording; -o corrects the rotation of the upper "
            "camera",
        ),
        RigState.EXCHANGED: (ERROR, "the cameras are exchanged: exchange them in the configuration"),
        RigState.BROKEN: (
            ERROR,
            "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: run omnid "
            "calibrate drive --only check on a recording",
        ),
    }
)


def rig_status(health: RigHealth) -> DiagnosticStatus:
    """Return the entry."""
    # 1. The state, with the words of the first pairs while the drive has shown nothing.
    state, finding, start = health.state, health.finding, health.start_finding
    level, message = RIG_STATES[state]
    if finding is None and health.warning:
        level, message = max(level, WARN), health.warning
    # 2. The evidence of the newest finding.
    values: dict[str, object] = {Key.STATE: state, "new_views": health.new_views, "needed_views": VIEWS}
    if start is not None:
        values["exchanged_matches"] = start.exchanged_matches
    if (newest := finding or start) is not None:
        names = ("turn_deg", "offset_px", "left_px", "matches", "tried")
        values |= {name: getattr(newest, name) for name in names}
    if finding is not None:
        values["age_s"] = health.finding_age_s
    return DiagnosticStatus.of(RIG, level, message, values)


def floor_status(camera_floor: CameraFloor) -> DiagnosticStatus:
    """Return where the height comes from, and its figures; a warning while it is not stated."""
    floor = camera_floor.floor
    if floor is None:
        return DiagnosticStatus(FLOOR, WARN, "the height of the cameras is not known: nothing is free", {})
    values = {Key.HEIGHT_M: floor.height_m, Key.SIGMA_M: floor.sigma_m, Key.TILT_DEG: math.degrees(floor.tilt_rad)}
    if camera_floor.stated is not None:
        return DiagnosticStatus.of(FLOOR, OK, "the rig states the height of the cameras", values)
    return DiagnosticStatus.of(FLOOR, WARN, "the height of the cameras is that which the images show", values)


def places_status(places: Places) -> DiagnosticStatus:
    """Return the state of the pose in the map, and the sizes and counters of the map."""
    state = places.state
    return DiagnosticStatus.of(
        PLACES, ERROR if state is MapState.LOST else OK, state, {Key.STATE: state, **places.counts}
    )


WRONG_WHEELS = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
SLIP = "wheels slip"


def motion_status(
    odometry: OdometryStage, inbox: MotionInbox, receiver: SensorReceiver | None = None
) -> DiagnosticStatus:
    """Return the entry of wheels and gyro: samples, their estimated errors, and the sensor that differs."""
    sensors, witness = odometry.sensors, odometry.witness
    values = {
        "wheel_samples": inbox.wheels,
        "gyro_samples": inbox.gyro,
        "dropped": inbox.dropped,
        "slips": sensors.slips,
        "refused_gyro": sensors.refused,
        **(_estimates(sensors, wheels=bool(inbox.wheels), gyro=bool(inbox.gyro)) if sensors.steps else {}),
    }
    if receiver is not None:
        values |= {f"{REFUSED_PREFIX}{key}": count for key, count in sorted(receiver.refused.items())}
    text = f"{witness.reason} {witness.detail}".strip()
    if sensors.is_slipping:
        text = SLIP
    if not sensors.wheels_are_sane:
        text = f"{WRONG_WHEELS}: {witness.detail}" if witness.detail else WRONG_WHEELS
    return DiagnosticStatus.of(MOTION, WARN if text else OK, text, values)


def _estimates(sensors: MotionSensors, *, wheels: bool, gyro: bool) -> dict[str, float]:
    """Return the estimated errors of the sensors that there are, each with its standard deviation."""
    found: dict[str, tuple[int, float]] = {}
    if wheels:
        found |= {"wheel_scale": (DISTANCE, 1.0), "turn_scale": (TURN, 1.0), "wheel_offset_ms": (WHEEL_OFFSET, 1e3)}
    if gyro:
        found |= {"gyro_offset_ms": (GYRO_OFFSET, 1e3)}
        found |= {f"gyro_bias_{axis}_radps": (BIAS.start + k, 1.0) for k, axis in enumerate("xyz")}
    values = {name: unit * float(sensors.values[state]) for name, (state, unit) in found.items()}
    return values | {f"{name}_sigma": unit * float(sensors.sigmas[state]) for name, (state, unit) in found.items()}


STEP_S: Final = 60.0  # The status warns of a step of the clock for this time: people look at it now and then.


def clock_status(clock: RobotClock) -> DiagnosticStatus:
    """Return whether the computer's clock was set while the robot ran, and by how much."""
    clock.follow()
    if not clock.steps:
        return DiagnosticStatus.of(CLOCK, OK, "followed", {"steps": 0})
    since_s = (clock.monotonic_ns() - clock.step.at_ns) * S_PER_NS
    values = {"steps": clock.steps, "step_s": f"{clock.step.change_ns * S_PER_NS:.3f}", "since_s": round(since_s)}
    message = f"it was set {clock.step.words}: the stamps follow it"
    return DiagnosticStatus.of(CLOCK, WARN if since_s < STEP_S else OK, message, values)


LIVE = "all parts are live"
FIXED = (
    "a part of the panoramas ({:.0%}) shows what is fixed to a camera, such as the reflection of its lens: "
    "obstacles are judged without it; `omnid calibrate drive --only mask` on a log of a turn makes a mask of it"
)


class ImagesStatus:
    """The entry; a call makes it from the newest pair."""

    def __init__(
        self,
        geometry: Geometry,
        statistics: RunStatistics,
        report: Callable[[str], object],
        obstacles: Obstacles | None = None,
    ) -> None:
        """report: takes a line for the log where the message changes, and where fixed parts are found first.

        obstacles: knows what part of the panoramas shows what is fixed to a camera.
        """
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._statistics, self._report, self._message = statistics, report, LIVE
        self._obstacles, self._has_fixed = obstacles, False

    def __call__(self) -> DiagnosticStatus:
        """Return the entry."""
        newest = self._statistics.newest
        if newest is None:
            return DiagnosticStatus(IMAGES, STALE, "no pose yet", {})
        tiles = newest.depth.panoramas.tiles
        lost = [side for side in SIDES if side in tiles.columns and tiles.columns[side].any()]
        message = "; ".join(self._named(side, tiles) for side in lost) or LIVE
        if message != self._message:
            self._report(f"images: {message}")
        self._message = message
        fixed = 0.0 if self._obstacles is None else self._obstacles.fixed_share
        if fixed and not self._has_fixed:
            self._report(f"images: {FIXED.format(fixed)}")
        self._has_fixed = fixed > 0
        values: dict[str, object] = {
            lost_parts_key(side): round((newest.stamp_ns - tiles.since_ns[side]) * 1e-9) for side in lost
        }
        if fixed:
            values[FIXED_PERCENT] = round(100 * fixed)
        return DiagnosticStatus.of(IMAGES, ERROR if lost else OK, message, values)

    def _named(self, side: Side, tiles: TileStates) -> str:
        """Return what a camera does not show, such as "the upper camera is blind from 300 to 40 degrees"."""
        columns, is_dead = tiles.columns[side], tiles.dead[side].any(axis=0)
        parts = [
            f"{word} {self._directions(found)}"
            for word, found in (("frozen", columns & is_dead), ("blind", columns & ~is_dead))
            if found.any()
        ]
        return f"the {side} camera is {' and '.join(parts)}"

    def _directions(self, columns: NDArray[np.bool_]) -> str:
        spans = self._unwatched.spans_deg(columns)
        if spans == [(0, 360)]:
            return "all around"
        return " and ".join(f"from {begin} to {end} degrees" for begin, end in spans)
