"""Cameras with given images, by v4l2loopback; for scripts in a guest."""

from __future__ import annotations

import os
import subprocess

from drivers.cameras import v4l2_ioctl as v4l2

DEVICES = "/dev/video10", "/dev/video11"
OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT


def load_loopback() -> None:
    """Load two loopback cameras with 4 buffers: with more, a reader that requests 4 has crashed the kernel."""
    subprocess.run(
        [
            "modprobe",
            "v4l2loopback",
            "devices=2",
            "video_nr=10,11",
            "card_label=omni-lower,omni-upper",
            "exclusive_caps=1,1",
            "max_buffers=4",
        ],
        check=True,
    )
    subprocess.run(["udevadm", "settle"], check=True)


class Loopback:
    """The writing end of a loopback camera, which is a capture device from the first image until it is closed."""

    def __init__(self, device: str, pixel_format: str, size_px: tuple[int, int]) -> None:
        self._fd = os.open(device, os.O_RDWR)
        asked = v4l2.Format(type=OUTPUT)
        pix = asked.fmt.pix
        pix.width, pix.height, pix.pixelformat, pix.field = *size_px, v4l2.fourcc_code(pixel_format), v4l2.PROGRESSIVE
        v4l2.call(self._fd, v4l2.S_FMT, asked)
        v4l2.call(self._fd, v4l2.STREAMON, v4l2.Int32(OUTPUT))  # else the end of the writer is not visible to readers

    def write(self, image: bytes) -> None:
        """Write an image; the kernel stamps it now."""
        os.write(self._fd, image)

    def close(self) -> None:
        """Stop the images, which a reader sees as a lost camera."""
        os.close(self._fd)
