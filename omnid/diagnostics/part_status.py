"""Entries of the status that describe parts of a run: rig, floor, places, motion, images."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.unwatched import Unwatched
from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, GYRO_OFFSET, TURN, WHEEL_OFFSET, MotionSensors
from omnid.core.rig.column_finding import RigState
from omnid.core.rig.rig_health import VIEWS, RigHealth
from omnid.core.stereo.tiles import SIDES, Side, TileStates
from omnid.diagnostics.run_summary import RunStatistics
from omnid.stages.geometry import Geometry
from omnid.stages.motion_inbox import MotionInbox
from omnid.stages.obstacles import CameraFloor
from omnid.stages.odometry import OdometryStage
from omnid.stages.places import Places
from omnid.tracking_state import MapState
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus
from omnid.transport.commands import SensorReceiver
from omnid.transport.status_names import (
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

LEVELS: Final = MappingProxyType(
    {
        RigState.UNCHECKED: OK,
        RigState.FITS: OK,
        RigState.DRIFTED: WARN,
        RigState.EXCHANGED: ERROR,
        RigState.BROKEN: ERROR,
    }
)
ADVICE: Final = MappingProxyType(
    {
        RigState.UNCHECKED: "not checked yet: the robot must drive past different places",
        RigState.FITS: "fits",
        RigState.DRIFTED: "drifted: run omnid calibrate drive --only check on a recording; -o corrects the rotation of "
        "the upper camera",
        RigState.EXCHANGED: "the cameras are exchanged: exchange them in the configuration",
        RigState.BROKEN: "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: "
        "run omnid calibrate drive --only check on a recording",
    }
)


def rig_status(health: RigHealth) -> DiagnosticStatus:
    """Return the entry."""
    # 1. The state, with the words of the first pairs while the drive has shown nothing.
    state, finding = health.state, health.finding
    level, message = LEVELS[state], ADVICE[state]
    values = {str(Key.STATE): str(state), "new_views": str(health.new_views), "needed_views": str(VIEWS)}
    if finding is None and health.warning:
        level, message = max(level, WARN), health.warning
    # 2. The evidence of the newest finding.
    start = health.start_finding
    if start is not None:
        values["exchanged_matches"] = str(start.exchanged_matches)
    newest = finding or (start.straight if start is not None else None)
    if newest is not None:
        values |= {
            "turn_deg": f"{newest.turn_deg:.3f}",
            "offset_px": f"{newest.offset_px:+.2f}",
            "left_px": f"{newest.left_px:.2f}",
            "matches": str(newest.matches),
            "tried": str(newest.tried),
        }
    if finding is not None:
        values["age_s"] = f"{health.finding_age_s:.0f}"
    return DiagnosticStatus(RIG, level, message, values)


def floor_status(camera_floor: CameraFloor) -> DiagnosticStatus:
    """Return where the height comes from, and its figures; a warning while it is not stated."""
    floor = camera_floor.floor
    if floor is None:
        return DiagnosticStatus(FLOOR, WARN, "the height of the cameras is not known: nothing is free", {})
    values = {
        str(Key.HEIGHT_M): f"{floor.height_m:.3f}",
        str(Key.SIGMA_M): f"{floor.sigma_m:.3f}",
        str(Key.TILT_DEG): f"{math.degrees(floor.tilt_rad):.2f}",
    }
    if camera_floor.stated is not None:
        return DiagnosticStatus(FLOOR, OK, "the rig states the height of the cameras", values)
    return DiagnosticStatus(FLOOR, WARN, "the height of the cameras is that which the images show", values)


def places_status(places: Places) -> DiagnosticStatus:
    """Return the state of the pose in the map, and the sizes and counters of the map."""
    state = places.state
    values = {str(Key.STATE): str(state)} | {name: str(count) for name, count in places.counts.items()}
    return DiagnosticStatus(PLACES, ERROR if state is MapState.LOST else OK, state, values)


WRONG_WHEELS = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
SLIP = "wheels slip"


def motion_status(
    odometry: OdometryStage,
    inbox: MotionInbox,
    receiver: SensorReceiver | None = None,
) -> Callable[[], DiagnosticStatus]:
    """Return a function that returns the entry: samples, their estimated errors, and the sensor that differs."""
    sensors = odometry.sensors

    def status() -> DiagnosticStatus:
        values = {
            "wheel_samples": str(inbox.wheels),
            "gyro_samples": str(inbox.gyro),
            "dropped": str(inbox.dropped),
            "slips": str(sensors.slips),
            "refused_gyro": str(sensors.refused),
        }
        if sensors.steps:
            values |= _estimates(sensors, wheels=bool(inbox.wheels), gyro=bool(inbox.gyro))
        if receiver is not None:
            values |= {f"{REFUSED_PREFIX}{key}": str(count) for key, count in sorted(receiver.refused.items())}
        witness = odometry.witness
        text = f"{witness.reason} {witness.detail}".strip()
        if not sensors.wheels_are_sane or sensors.is_slipping:
            text = SLIP if sensors.wheels_are_sane else WRONG_WHEELS
        return DiagnosticStatus(MOTION, WARN if text else OK, text, values)

    return status


def _estimates(sensors: MotionSensors, *, wheels: bool, gyro: bool) -> dict[str, str]:
    names = [("wheel_scale", DISTANCE, 1.0), ("turn_scale", TURN, 1.0), ("wheel_offset_ms", WHEEL_OFFSET, 1e3)]
    of_gyro = [
        ("gyro_offset_ms", GYRO_OFFSET, 1e3),
        *((f"gyro_bias_{axis}_radps", BIAS.start + k, 1.0) for k, axis in enumerate("xyz")),
    ]
    chosen = (names if wheels else []) + (of_gyro if gyro else [])
    return {
        key: text
        for name, state, unit in chosen
        for key, text in (
            (name, f"{unit * sensors.values[state]:.5f}"),
            (f"{name}_sigma", f"{unit * sensors.sigmas[state]:.5f}"),
        )
    }


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
        fixed_share: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """report: takes a line for the log where the message changes, and where fixed parts are found first.

        fixed_share: share of the panoramas that shows what is fixed to a camera.
        """
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._statistics, self._report, self._message = statistics, report, LIVE
        self._fixed_share, self._has_fixed = fixed_share, False

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
        fixed = self._fixed_share()
        if fixed and not self._has_fixed:
            self._report(f"images: {FIXED.format(fixed)}")
        self._has_fixed = fixed > 0
        values = {lost_parts_key(side): f"{(newest.stamp_ns - tiles.since_ns[side]) * 1e-9:.0f}" for side in lost}
        if fixed:
            values[FIXED_PERCENT] = f"{100 * fixed:.0f}"
        return DiagnosticStatus(IMAGES, ERROR if lost else OK, message, values)

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
