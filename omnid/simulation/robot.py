"""A simulated robot: its cameras and sensors, and how its wheels move it over the ground."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from calib import se3
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from drivers.motors.simulated_motor import MotionLimits
from omnid.simulation.rendering.sensor import Sensor

CAMERA_HEIGHT_M: Final = 0.9  # Height of the lower viewpoint over the floor.
BASELINE_M: Final = 0.2
IMAGE_PX: Final = 512
# Radii of the horizon at scale 1 and of the mirror's rim, as a fraction of the image's width.
HORIZON = 207.5676 / 768
RIM = 373.0 / 768
TOPICS = ("/lower/image_raw/compressed", "/upper/image_raw/compressed")
# The image's centre shows the floor; up in the image is forward, and the mirror's flip is in fu < 0.
R_RIG_CAM = np.array([[0, -1.0, 0], [-1, 0, 0], [0, 0, -1]])


@dataclass(frozen=True, slots=True)
class WheelErrors:
    """Deviation of the wheels from those of the configuration.

    Defaults: wheels measured by a ruler, not calibrated, on a hard floor. Their diameters are 1 % off and differ by
    0.7 % (Borenstein, Feng 1996: unequal and wrong diameters, and the track, are the systematic errors). Noise adds to
    the variance in proportion to the way (Chong, Kleeman 1997): of 10 m, 6 mm of each wheel.
    """

    left: float = 0.0135  # share by which the left wheel rolls farther than configured
    right: float = 0.0065
    noise: float = 0.002  # standard deviation of the travel of each wheel, per root of a metre [m]


@dataclass(frozen=True, slots=True)
class GyroErrors:
    """Bias about base x, y, z, and noise of a sample, rad/s."""

    bias_radps: tuple[float, float, float] = (0.004, -0.003, 0.006)
    noise_radps: float = 0.003
    rate_hz: float = 100.0


@dataclass(frozen=True)
class SimulatedRobot:
    """A disc with two driven wheels and two cameras; the motor controller is that of the configuration."""

    rig: Rig
    sensor: Sensor = field(default_factory=Sensor)
    radius_m: float = 0.2
    height_m: float = 1.2
    limits: MotionLimits = field(default_factory=lambda: MotionLimits(acceleration_mps2=1.5, lag_s=0.06))
    wheels: WheelErrors = WheelErrors()
    gyro: GyroErrors = GyroErrors()
    has_odometry: bool = True  # the daemon is given what the motor controller reports of its wheels
    has_gyro: bool = True
    rate_hz: float = 10.0  # of the cameras
    samples: int = 2  # in lock-step: rays of a pixel, per axis
    pose_delay_s: float = 0.1  # in lock-step: from the exposure to the pose's arrival at the controller


def make_robot(size_px: int = IMAGE_PX, rig: Rig | None = None) -> SimulatedRobot:
    """Return the default robot with images of that size before straight parabolic mirrors, or with another rig."""
    if rig is not None:
        return SimulatedRobot(rig)
    focal_px, centre = HORIZON * size_px, ((size_px - 1) / 2, (size_px - 1) / 2)
    camera = UnifiedCamera(1.0, (-focal_px, focal_px), centre, (size_px, size_px))
    lower, upper = (
        MountedCamera(
            camera, se3.inverse(se3.transform(R_RIG_CAM, [0.0, 0.0, height_m])), Mask(centre, 0.0, RIM * size_px)
        )
        for height_m in (0.0, BASELINE_M)
    )
    return SimulatedRobot(Rig(lower, upper, se3.transform(np.eye(3), [0.0, 0.0, CAMERA_HEIGHT_M]), TOPICS))


def with_masks(rig: Rig) -> Rig:
    """Return the rig with a mask of each camera: the whole image where none is known."""
    lower, upper = (replace(mounted, mask=mounted.visible) for mounted in (rig.lower, rig.upper))
    return replace(rig, lower=lower, upper=upper)
