"""Settings of the cameras, of the pairs of their images, and of the times of exposure."""

from __future__ import annotations

from dataclasses import dataclass, fields

from drivers.cameras.v4l2_settings import EXPOSURE_MODES, PIXEL_FORMATS, POWER_LINE, SWITCH, V4l2Settings
from drivers.errors import DriverError
from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class CamerasConfig:
    """Devices and settings of the cameras; both have the same settings."""

    rig: str = knob("/etc/omnid/rig.toml", "calibration of the cameras, see `omnid calibrate`")
    lower: str = knob("/dev/omnid/lower", "device of the lower camera, by a persistent name, see `omnid cameras`")
    upper: str = knob("/dev/omnid/upper", "device of the upper camera")
    width_px: int = knob(1280, "width of the images, px", low=16, high=16384)
    height_px: int = knob(960, "height of the images, px", low=16, high=16384)
    rate_hz: float = knob(30.0, "images per second; 0: the camera's own rate", low=0, high=1000)
    pixel_format: str = knob("auto", "pixel format of the images on USB", choices=PIXEL_FORMATS)
    auto_exposure: str = knob(
        "rig",
        "automatic exposure; 'rig': omnid run sets exposure and gain of both cameras "
        "alike, by what the mirrors show without the black corners; where they cannot be set, "
        "and in other commands, as 'on'; 'on': each camera's own; 'keep': as it is",
        choices=EXPOSURE_MODES,
    )
    exposure_limit_ms: float = knob(
        20.0,
        "longest exposure of 'rig', ms, and at most 90 % of the images' period; "
        "1 ms blurs by 0.16 px in a turn of 45 deg/s (panorama of 1300 columns)",
        low=0.1,
        high=1000,
    )
    exposure_us: int = knob(0, "fixed exposure, us; 0: not fixed", low=0, high=10_000_000)
    auto_gain: str = knob("keep", "automatic gain", choices=SWITCH)
    gain: int = knob(-1, "fixed gain in the camera's own units; -1: not fixed", low=-1, high=2**31 - 1)
    auto_white_balance: str = knob("keep", "automatic white balance", choices=SWITCH)
    auto_focus: str = knob("keep", "automatic focus; best off: each focus has another calibration", choices=SWITCH)
    focus: int = knob(-1, "fixed focus in the camera's own units; -1: not fixed", low=-1, high=2**31 - 1)
    power_line: str = knob("keep", "mains frequency against the flicker of lamps, Hz", choices=POWER_LINE)
    controls: tuple[str, ...] = knob((), "other controls by their names in v4l2-ctl --list-ctrls: 'sharpness=2'")
    buffers: int = knob(4, "image buffers of the kernel", low=2, high=32)
    timeout_s: float = knob(2.0, "a camera without an image for so long is opened again, s", low=0.05, high=60)
    retry_s: float = knob(2.0, "longest wait between two tries to open a lost camera, s", low=0.05, high=60)

    def settings(self, camera: str) -> V4l2Settings:
        """Return the settings of the lower or the upper camera; DriverError if they contradict each other."""
        shared = {entry.name: getattr(self, entry.name) for entry in fields(V4l2Settings) if entry.name != "device"}
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

    tolerance_ms: float = knob(
        0.0,
        "largest difference between the stamps of a pair, ms; 0: half the period of the "
        "images, so that cameras may run freely",
        low=0,
        high=1000,
    )
    repeated_images: str = knob(
        "drop",
        "images with all pixels as before, which a frozen camera delivers; 'use' only for simulators without noise",
        choices=("drop", "use"),
    )


@dataclass(frozen=True, slots=True)
class TimingConfig:
    """Times of exposure relative to the stamps; 0: as the rig's file says, see `omnid calibrate drive`."""

    line_time_us: float = knob(
        0.0,
        "rolling shutter: time from the exposure of an image row to that of the next, us; "
        "the stamp is that of the first row; 0: as in the rig's file, or global",
        low=0,
        high=1000,
    )
    upper_delay_ms: float = knob(
        0.0,
        "time by which the upper camera's exposure is later than the stamps say, ms; 0: as in the rig's file",
        low=-1000,
        high=1000,
    )
