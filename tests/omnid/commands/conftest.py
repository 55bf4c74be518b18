"""The command line, and rigs for the calibration commands: the same as those of the geometry."""

from tests.calib.conftest import ocam_rig, omni_rig, rig, shared_data
from tests.replay.conftest import omnid, taken_port

__all__ = ["ocam_rig", "omni_rig", "omnid", "rig", "shared_data", "taken_port"]
