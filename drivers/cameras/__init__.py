"""Cameras: V4L2 devices, and recorded logs that replace them."""
