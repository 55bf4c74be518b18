"""Settings of a V4L2 camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from drivers.errors import DriverError

# V4L2's fourcc -> the name in a Frame, in the order of preference: no decoding first, then fewer bytes
ENCODINGS: Final = {"GREY": "mono8", "NV12": "nv12", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg"}
MAX_SIZE_PX: Final = 16384
SWITCH: Final = ("keep", "on", "off")  # "keep" leaves a control as the camera has it
EXPOSURE_MODES: Final = (*SWITCH, "rig")  # "rig": set by a run, by the requests of CameraExposure, else as "on"
POWER_LINE: Final = ("keep", "off", "50", "60", "auto")
PIXEL_FORMATS: Final = ("auto", *ENCODINGS)
_MAX_CONTROL: Final = 2**31 - 1  # struct v4l2_control holds a signed 32-bit value


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Device, image and controls; raises DriverError for a value out of range."""

    device: str  # a path that persists when the camera is plugged in again: /dev/omnid/lower, /dev/v4l/by-path/...
    width_px: int = 1280
    height_px: int = 960
    rate_hz: float = 30.0  # 0: the device's own
    pixel_format: str = "auto"  # or GREY, NV12, YUYV, UYVY, MJPG, JPEG
    auto_exposure: str = "keep"  # keep, on, off or rig
    exposure_us: int = 0  # above 0: fixed, automatic exposure off; in steps of 100
    auto_gain: str = "keep"
    gain: int = -1  # 0 and above: fixed, in the device's own units
    power_line: str = "keep"  # keep, off, 50, 60 (Hz) or auto: suppresses the flicker of lamps
    controls: tuple[str, ...] = ()  # any others, as `v4l2-ctl --list-ctrls` names them: "focus_absolute=2"
    buffers: int = 4  # v4l2loopback needs exactly this number
    timeout_s: float = 2.0  # the device is opened again after this time without an image
    retry_s: float = 2.0  # longest wait between two tries to open a lost device

    def __post_init__(self) -> None:
        for name, allowed in (
            ("pixel_format", PIXEL_FORMATS),
            ("power_line", POWER_LINE),
            ("auto_exposure", EXPOSURE_MODES),
            ("auto_gain", SWITCH),
        ):
            self._require(name, getattr(self, name) in allowed, f"one of {', '.join(allowed)}")
        for name, low, high in (
            ("width_px", 16, MAX_SIZE_PX),
            ("height_px", 16, MAX_SIZE_PX),
            ("rate_hz", 0, 1000),
            ("buffers", 2, 32),
            ("timeout_s", 0.05, 60),
            ("retry_s", 0.05, 60),
            ("exposure_us", 0, 10**7),
            ("gain", -1, _MAX_CONTROL),
        ):
            value = getattr(self, name)
            self._require(name, low <= value <= high, f"{low} to {high}")
        self._require("device", self.device.startswith("/"), "a path such as /dev/v4l/by-path/..., see `omnid cameras`")
        for text in self.controls:
            self._require("controls", re.fullmatch(r"\w+ *= *-?\d{1,10}", text) is not None, "entries such as 'gain=3'")
        for name, fixed in (("exposure", self.exposure_us > 0), ("gain", self.gain >= 0)):
            self._require(
                f"auto_{name}",
                not (fixed and getattr(self, f"auto_{name}") == "on"),
                f"off where a fixed {name} is set",
            )

    @property
    def is_regulated(self) -> bool:
        """True if a run sets the exposure by requests."""
        return self.auto_exposure == "rig" and not self.exposure_us

    def _require(self, name: str, valid: bool, allowed: str) -> None:
        if not valid:
            raise DriverError(f"camera {self.device}: {name} is {getattr(self, name)!r}; give {allowed}")
