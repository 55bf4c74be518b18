"""Settings of the cameras, and of the pairs of their images."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal

from msgspec import Meta

from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError


@dataclass(frozen=True, slots=True)
class CamerasConfig:
    """Devices and settings of the cameras; both have the same settings."""

    rig: Annotated[str, "calibration of the cameras, see `omnid calibrate`"] = "/etc/omnid/rig.toml"
    lower: Annotated[str, "device of the lower camera, by a persistent name, see `omnid cameras`"] = "/dev/omnid/lower"
    upper: Annotated[str, "device of the upper camera"] = "/dev/omnid/upper"
    width_px: Annotated[int, Meta(ge=16, le=16384), "width of the images, px"] = 1280
    height_px: Annotated[int, Meta(ge=16, le=16384), "height of the images, px"] = 960
    rate_hz: Annotated[float, Meta(ge=0, le=1000), "images per second; 0: the camera's own rate"] = 30.0
    pixel_format: Annotated[
        Literal["auto", "GREY", "NV12", "YUYV", "UYVY", "MJPG", "JPEG"], "pixel format of the images on USB"
    ] = "auto"
    bits: Annotated[
        Literal[8, 10, 12, 16],
        "bits of the camera in the samples of logs that have 16: a camera of 10 bits may fill 10 of them, or all",
    ] = 16
    auto_exposure: Annotated[
        Literal["keep", "on", "off", "rig"],
        "automatic exposure; 'rig': omnid run sets exposure and gain of both cameras "
        "alike, by what the mirrors show without the black corners; where they cannot be set, "
        "and in other commands, as 'on'; 'on': each camera's own; 'keep': as it is",
    ] = "rig"
    exposure_limit_ms: Annotated[
        float,
        Meta(ge=0.1, le=1000),
        "longest exposure of 'rig', ms, and at most 90 % of the images' period; "
        "1 ms blurs by 0.16 px in a turn of 45 deg/s (panorama of 1300 columns)",
    ] = 20.0
    exposure_us: Annotated[int, Meta(ge=0, le=10_000_000), "fixed exposure, us; 0: not fixed"] = 0
    auto_gain: Annotated[Literal["keep", "on", "off"], "automatic gain"] = "keep"
    gain: Annotated[int, Meta(ge=-1, le=2**31 - 1), "fixed gain in the camera's own units; -1: not fixed"] = -1
    power_line: Annotated[
        Literal["keep", "off", "50", "60", "auto"], "mains frequency against the flicker of lamps, Hz"
    ] = "keep"
    controls: Annotated[
        tuple[str, ...],
        "other controls by their names in v4l2-ctl --list-ctrls; best with a fixed focus, as each one has another "
        "calibration: 'focus_automatic_continuous=0', 'focus_absolute=20'",
    ] = ()

    def settings(self, camera: str) -> V4l2Settings:
        """Return the settings of the lower or the upper camera; DriverError if they contradict each other."""
        shared = {entry.name: getattr(self, entry.name) for entry in fields(V4l2Settings) if hasattr(self, entry.name)}
        return V4l2Settings(device=self.lower if camera == "lower" else self.upper, **shared)

    def require_two_devices(self) -> None:
        """Raise DriverError where one device is named for both cameras."""
        if self.lower == self.upper:
            raise DriverError(
                f"cameras.lower and cameras.upper are both {self.lower!r}: expected two devices, see `omnid cameras`"
            )


@dataclass(frozen=True, slots=True)
class PairConfig:
    """Synchronisation of the cameras."""

    tolerance_ms: Annotated[
        float,
        Meta(ge=0, le=1000),
        "largest difference between the stamps of a pair, ms; 0: half the period of the "
        "images, so that cameras may run freely",
    ] = 0.0
    repeated_images: Annotated[
        Literal["drop", "use"],
        "images with all pixels as before, which a frozen camera delivers; 'use' only for simulators without noise",
    ] = "drop"
