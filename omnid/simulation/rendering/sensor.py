"""Model of a real camera's sensor: blur, struts, hub, vignetting, changing light, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Mask

Floats = NDArray[np.float32]
# Grey level of struts and hub.
FITTING_GREY = 18.0
# Samples per pixel and axis of a strut's edge.
EDGE_STEPS = 4


@dataclass(frozen=True, slots=True)
class Sensor:
    """Parameters of the sensor; lengths are fractions of the image's width, angles in the image."""

    noise_sigma: float = 1.5
    blur_px: float = 0.5
    black_level: float = 5.0
    jpeg_quality: int = 90
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
        self.sensor, (width, height) = sensor, size
        # 1. The part (H, W) of each pixel that struts and hub hide, 0 to 1; they are fixed to the camera.
        fine = (np.arange(side * EDGE_STEPS) / EDGE_STEPS - 0.5 + 0.5 / EDGE_STEPS for side in size)
        x, y = np.meshgrid(*(at - centre for at, centre in zip(fine, mask.center, strict=True)))
        hidden = np.hypot(x, y) <= sensor.hub * width if sensor.hub else np.zeros(x.shape, bool)
        for angle in np.deg2rad(sensor.strut_angles_deg):
            along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            hidden |= (along > 0) & (np.abs(across) <= sensor.strut_width * width / 2)
        self.hidden: Floats = np.asarray(cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA))
        # 2. The factor (H, W) on the brightness: 1 in the middle, 1 - vignette at the rim, quadratic in the radius.
        x, y = np.meshgrid(np.arange(width) - mask.center[0], np.arange(height) - mask.center[1])
        rim_px = min(mask.outer_px, width / 2)
        self.falloff: Floats = (1 - sensor.vignette * np.minimum((x**2 + y**2) / rim_px**2, 1)).astype(np.float32)

    def expose(self, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the sensor's image (H, W) uint8 of an ideal one."""
        s = self.sensor
        gain = s.brightness * max(0.0, 1 + s.flicker * float(rng.standard_normal()))
        grey = (ideal * self.falloff * np.float32(gain)) * (1 - self.hidden) + FITTING_GREY * self.hidden
        if s.blur_px > 0:
            grey = cv2.GaussianBlur(grey, (0, 0), s.blur_px)
        noise = s.noise_sigma * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey * (1 - s.black_level / 255) + s.black_level + noise), 0, 255).astype(np.uint8)

    def jpeg(self, image: NDArray[np.uint8]) -> bytes:
        """Return the image as grey JPEG."""
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.sensor.jpeg_quality])
        return data.tobytes()
