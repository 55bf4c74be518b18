"""Rigs for the calibration commands: the same as those of the geometry."""

from tests.calib.conftest import ocam_rig, omni_rig, rig, shared_data

__all__ = ["ocam_rig", "omni_rig", "rig", "shared_data"]
