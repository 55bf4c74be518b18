"""Fits of cameras and rigs to what they saw: least squares, boards, drives, drift and uncertainty of a rig."""
