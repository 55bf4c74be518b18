"""Settings of a V4L2 camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from drivers.errors import DriverError

# V4L2's fourcc -> the name in a Frame, in the order of preference: no decoding first, then fewer bytes
ENCODINGS: Final = {"GREY": "mono8", "NV12": "nv12", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg"}


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Device, image and controls. "keep" leaves a control as the camera has it. DriverError for a contradiction."""

    device: str  # a path that persists when the camera is plugged in again: /dev/omnid/lower, /dev/v4l/by-path/...
    width_px: int = 1280
    height_px: int = 960
    rate_hz: float = 30.0  # 0: the device's own
    pixel_format: str = "auto"  # or one of ENCODINGS
    auto_exposure: str = "keep"  # keep, on, off or rig: set by a run, by the requests of CameraExposure, else as "on"
    exposure_us: int = 0  # above 0: fixed, automatic exposure off; in steps of 100
    auto_gain: str = "keep"  # keep, on, off
    gain: int = -1  # 0 and above: fixed, in the device's own units
    power_line: str = "keep"  # keep, off, 50, 60 (Hz) or auto: suppresses the flicker of lamps
    controls: tuple[str, ...] = ()  # any others, as `v4l2-ctl --list-ctrls` names them: "focus_absolute=2"
    buffers: int = 4  # v4l2loopback needs exactly this number
    timeout_s: float = 2.0  # the device is opened again after this time without an image
    retry_s: float = 2.0  # longest wait between two tries to open a lost device

    def __post_init__(self) -> None:
        problem = ""
        if not self.device.startswith("/"):
            problem = "give a path such as /dev/v4l/by-path/..., see `omnid cameras`"
        for text in self.controls:
            if not re.fullmatch(r"\w+ *= *-?\d{1,10}", text):
                problem = f"controls has {text!r}; give entries such as 'gain=3'"
        for name, is_fixed in (("exposure", self.exposure_us > 0), ("gain", self.gain >= 0)):
            if is_fixed and getattr(self, f"auto_{name}") == "on":
                problem = f"auto_{name} is 'on'; give 'off' where a fixed {name} is set"
        if problem:
            raise DriverError(f"camera {self.device}: {problem}")

    @property
    def is_regulated(self) -> bool:
        """True if a run sets the exposure by requests."""
        return self.auto_exposure == "rig" and not self.exposure_us
