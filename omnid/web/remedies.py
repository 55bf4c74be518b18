"""Remedies: advice for each status that is not good."""

from __future__ import annotations

from typing import Final

from omnid.transport import status_names
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import PREFIX, Key

_OF_PART: Final = {
    status_names.ODOMETRY: "stop, then drive back slowly to a place that it has seen; check light and mirrors",
    status_names.PAIRING: "on the robot: omnid doctor",
    status_names.WHEELS: "remove the cause, then arm; on the robot: omnid doctor",
    status_names.BUS: "see bus.robot and bus.connect in the robot's configuration",
    status_names.RECORDING: "make room on the disk, or change record.folder",
    status_names.LOAD: "close other programs on the robot, or start it with --profile small",
    status_names.EXPOSURE: "switch lights on, or set cameras.exposure_limit_ms",
    status_names.FLOOR: "state the height of the cameras in the rig: omnid calibrate drive --only height",
    status_names.IMAGES: "clean the mirrors, look for glare and darkness, check the cameras and their driver",
    status_names.RIG: "omnid calibrate drive --only check on a recording; name the right rig.toml, or calibrate again",
    status_names.MOTION: "check motor.drive in the configuration, and the grip of the wheels",
    status_names.MAP_FILE: "make room on the disk, or change places.map",
    status_names.NAVIGATION: "remove the cause that the robot names, then `omnid goto` or `omnid route repeat` again",
    status_names.REQUESTS: "see the robot's log for the reason",
    status_names.PLACES: "drive slowly to where the map was made; where everything has changed, make a new map",
}
_CAMERA: Final = "check its cable and its power; on the robot: omnid doctor"


def remedy_of(status: DiagnosticStatus) -> str:
    """Return what to do: the robot's own words, else the usual advice for that part; empty where there is none."""
    if status.values.get(Key.REMEDY):
        return status.values[Key.REMEDY]
    if status.name.startswith(PREFIX) and status.name.endswith(" camera"):
        return _CAMERA
    return _OF_PART.get(status.name, "")
