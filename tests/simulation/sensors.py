"""Sensors of real cameras: struts and a hub before them, a dark rim, brightness that changes; and their JPEG."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Mask
from omnid.simulation.rendering.ray_caster import Floats, Sensor

# Grey level of struts and hub.
FITTING_GREY = 18.0
# Samples per pixel and axis of a strut's edge.
EDGE_STEPS = 4
JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class FlawedSensor(Sensor):
    """A sensor and what is before it; lengths are fractions of the image's width, angles in the image."""

    is_compressed: bool = False  # the frames of a drive are JPEG, too
    vignette: float = 0.0  # how much darker the rim is, 0 to 1
    flicker: float = 0.0  # standard deviation of the brightness from frame to frame
    brightness: float = 1.0  # factor on the ideal image
    strut_angles_deg: tuple[float, ...] = ()
    strut_width: float = 0.014
    hub: float = 0.0  # radius


class MountedSensor:
    """One camera's sensor with its fixed patterns, computed once."""

    def __init__(self, sensor: Sensor, mask: Mask, size: tuple[int, int]) -> None:
        """mask, size: of the camera, whose images are (width, height)."""
        flawed, (width, height) = sensor if isinstance(sensor, FlawedSensor) else FlawedSensor(**asdict(sensor)), size
        self.sensor = flawed
        # 1. The part (H, W) of each pixel that struts and hub hide, 0 to 1; they are fixed to the camera.
        fine = (np.arange(side * EDGE_STEPS) / EDGE_STEPS - 0.5 + 0.5 / EDGE_STEPS for side in size)
        x, y = np.meshgrid(*(at - centre for at, centre in zip(fine, mask.center, strict=True)))
        hidden = np.hypot(x, y) <= flawed.hub * width if flawed.hub else np.zeros(x.shape, bool)
        for angle in np.deg2rad(flawed.strut_angles_deg):
            along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            hidden |= (along > 0) & (np.abs(across) <= flawed.strut_width * width / 2)
        self.hidden: Floats = np.asarray(cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA))
        # 2. The factor (H, W) on the brightness: 1 in the middle, 1 - vignette at the rim, quadratic in the radius.
        x, y = np.meshgrid(np.arange(width) - mask.center[0], np.arange(height) - mask.center[1])
        rim_px = min(mask.outer_px, width / 2)
        self.falloff: Floats = (1 - flawed.vignette * np.minimum((x**2 + y**2) / rim_px**2, 1)).astype(np.float32)

    def expose(self, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the sensor's image (H, W) uint8 of an ideal one."""
        gain = self.sensor.brightness * max(0.0, 1 + self.sensor.flicker * float(rng.standard_normal()))
        grey = (ideal * self.falloff * np.float32(gain)) * (1 - self.hidden) + FITTING_GREY * self.hidden
        return self.sensor.expose(grey, rng)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W) as grey JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
