"""How a V4L2 camera is to be set."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from drivers.cameras.v4l2_modes import ENCODINGS
from drivers.errors import DriverError

SWITCH: Final = ("keep", "on", "off")  # "keep" leaves a control as the camera has it
POWER_LINE: Final = ("keep", "off", "50", "60", "auto")
PIXEL_FORMATS: Final = ("auto", *ENCODINGS)


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """Device, image and controls; DriverError for a value that no camera takes."""

    device: str  # a path that stays when the camera is plugged in again: /dev/omnid/lower, /dev/v4l/by-path/...
    width_px: int = 1280
    height_px: int = 960
    rate_hz: float = 30.0  # 0: whatever the device does
    pixel_format: str = "auto"  # or GREY, NV12, YUYV, UYVY, MJPG, JPEG
    auto_exposure: str = "keep"  # keep, on or off
    exposure_us: int = 0  # above 0: fixed, automatic off; in steps of 100
    auto_gain: str = "keep"
    gain: int = -1  # from 0: fixed, in the device's own units
    auto_white_balance: str = "keep"
    auto_focus: str = "keep"
    focus: int = -1  # from 0: fixed, in the device's own units
    power_line: str = "keep"  # keep, off, 50, 60 (Hz) or auto: against flicker of lamps
    controls: tuple[str, ...] = ()  # any other, as `v4l2-ctl --list-ctrls` names it: "sharpness=2"
    buffers: int = 4  # v4l2loopback wants this number
    timeout_s: float = 2.0  # without a image for so long, the device is opened anew
    retry_s: float = 2.0  # longest wait between two tries to open a lost device

    def __post_init__(self) -> None:
        for name, allowed in (("pixel_format", PIXEL_FORMATS), ("power_line", POWER_LINE), ("auto_exposure", SWITCH),
                              ("auto_gain", SWITCH), ("auto_white_balance", SWITCH), ("auto_focus", SWITCH)):
            self._require(name, getattr(self, name) in allowed, f"one of {', '.join(allowed)}")
        for name, low, high in (("width_px", 16, 16384), ("height_px", 16, 16384), ("rate_hz", 0, 1000),
                                ("buffers", 2, 32), ("timeout_s", 0.05, 60), ("retry_s", 0.05, 60),
                                ("exposure_us", 0, 10**7), ("gain", -1, 2**31 - 1), ("focus", -1, 2**31 - 1)):
            value = getattr(self, name)
            self._require(name, low <= value <= high, f"{low} to {high}")
        self._require("device", self.device.startswith("/"), "a path such as /dev/v4l/by-path/..., see `omnid cameras`")
        for text in self.controls:
            self._require("controls", re.fullmatch(r"\w+ *= *-?\d{1,10}", text) is not None, "entries such as 'gain=3'")
        for name, fixed in (("exposure", self.exposure_us > 0), ("gain", self.gain >= 0), ("focus", self.focus >= 0)):
            self._require(f"auto_{name}", not (fixed and getattr(self, f"auto_{name}") == "on"),
                          f"off where a fixed {name} is set")

    def _require(self, name: str, fine: bool, allowed: str) -> None:
        if not fine:
            raise DriverError(f"camera {self.device}: {name} is {getattr(self, name)!r}; give {allowed}")
