"""Status of the floor: the height of the cameras above it, stated or found."""

from __future__ import annotations

import math

from omnid.stages.floor import CameraFloor
from omnid.transport.codec import OK, WARN
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import FLOOR, Key


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
