"""Cameras: V4L2 devices of the Linux kernel, and recorded logs that replace them.

Begin with `v4l2_camera.py`: a source of frames that reports a lost device once and opens it again until it is back; it
also checks sequence numbers and stamps. `v4l2_device.py` is one opening of a device (format, rate, buffers, streaming,
controls that are verified, exposure that a run regulates) and the list of those plugged in; `v4l2_ioctl.py` has the
kernel's structures and requests. `camera_state.py` holds status and counters, which any thread may read.
`log_camera.py` plays a log at its own pace with new stamps, for tests and demonstrations of the daemon.
"""
