"""Tests of omnid, its drivers and its geometry."""
