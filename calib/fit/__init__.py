"""Calibration from board views: intrinsics, rig, bundle adjustment, drift of a rig."""
