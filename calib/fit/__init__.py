"""Calibration from board views: intrinsics, rig, bundle adjustment."""
