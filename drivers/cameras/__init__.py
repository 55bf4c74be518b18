"""Cameras: V4L2 devices, and a log in the place of one."""
