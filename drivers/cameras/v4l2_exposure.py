"""Set exposure time and gain of an open V4L2 device by requests, and give them back to its own automatic mode."""

from __future__ import annotations

import errno
from contextlib import suppress
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_exposure import (
    CameraExposure,
    ExposureRanges,
    ExposureRequest,
    ExposureSetting,
    ValueRange,
)
from drivers.cameras.v4l2_controls import (
    AUTO_EXPOSURE,
    AUTO_GAIN,
    EXPOSURE,
    EXPOSURE_UNIT_US,
    GAIN,
    MANUAL_EXPOSURE,
    list_controls,
    read_control,
)

_LOST: Final = (errno.ENODEV, errno.EBUSY)  # the camera is opened again, with its request


class ExposureControls:
    """The controls of an open device.

    The automatic modes are switched off by the first request, and on again by the request for none and by `release`;
    a gain that was set before is set again.
    """

    def __init__(self, fd: int, *, with_gain: bool = True) -> None:
        """with_gain: False leaves the gain as it is, also where the device has one."""
        self._fd, self._with_gain = fd, with_gain
        offered = list_controls(fd)
        self._offered = offered
        exposure, gain = offered.get(EXPOSURE), offered.get(GAIN)
        self.ranges: ExposureRanges | None = None  # None: the device has no exposure time to set
        if exposure is not None:
            low, high, step = (value * EXPOSURE_UNIT_US for value in (exposure.low, exposure.high, exposure.step))
            gains = None if gain is None or not with_gain else ValueRange(gain.low, gain.high, gain.step)
            self.ranges = ExposureRanges(ValueRange(low, high, step), gains)
        self._before: list[tuple[int, int]] = []  # control and value, while requests are in force
        self._done: ExposureRequest | None = None

    def read(self) -> ExposureSetting | None:
        """Return the values in force as the device reports them; None where it does not."""
        if self.ranges is None:
            return None
        with suppress(OSError):
            gain = None if self.ranges.gain is None else read_control(self._fd, GAIN)
            return ExposureSetting(read_control(self._fd, EXPOSURE) * EXPOSURE_UNIT_US, gain)
        return None

    def follow(self, exposure: CameraExposure, stamp_ns: int) -> None:
        """Carry out the newest request, if it is due after an image with that stamp.

        A value that the device refuses is kept as `exposure.problem`. Raises OSError for a lost device.
        """
        request = exposure.request
        if request is None or request is self._done or stamp_ns < request.after_ns or exposure.problem:
            return
        self._done = request
        try:
            if request.setting is None:
                self.release()
            else:
                self._set(request.setting)
            exposure.in_force = self.read()
        except OSError as error:
            if error.errno in _LOST:
                raise
            with suppress(OSError):
                self.release()
            exposure.problem = f"it refused an exposure ({error.strerror})"

    def release(self) -> None:
        """Give exposure and gain back to the automatic modes that were on; raise OSError for a lost device."""
        while self._before:
            self._write(*self._before.pop())

    def _set(self, setting: ExposureSetting) -> None:
        if not self._before:
            self._take_over()
        self._write(EXPOSURE, round(setting.exposure_us / EXPOSURE_UNIT_US))
        if setting.gain is not None:
            self._write(GAIN, setting.gain)

    def _take_over(self) -> None:
        """Switch the automatic modes off, and keep what `release` restores: values first, then modes."""
        modes = ((AUTO_EXPOSURE, MANUAL_EXPOSURE), (AUTO_GAIN, 0))
        changed = [
            (control, value)
            for control, value in modes
            if control in self._offered and (control != AUTO_GAIN or self._with_gain)
        ]
        kept = [(control, read_control(self._fd, control)) for control, _ in changed]
        if self._with_gain and GAIN in self._offered:
            kept.append((GAIN, read_control(self._fd, GAIN)))
        self._before = kept
        for control, value in changed:
            self._write(control, value)

    def _write(self, control: int, value: int) -> None:
        v4l2.call(self._fd, v4l2.S_CTRL, v4l2.V4l2Control(control, value))
