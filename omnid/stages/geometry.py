"""What every stage knows about the rig: the cameras with their masks, the cylinder, and the frames between."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.masks.rim import find_rim
from calib.models.camera import Mask
from calib.panorama import Cylinder, fit_cylinder
from calib.rig import MountedCamera, Rig
from drivers.frame import Camera, Frame
from omnid.config import PanoramaConfig
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.stages.decoder import Decoder

Array = NDArray[np.float64]

LOOKS, FRAMES_A_LOOK = 5, 12  # so often the rim is looked for, each time in the maximum of so many more images


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A rig whose masks are known, and the panorama that fits it."""

    rig: Rig
    cylinder: Cylinder

    @property
    def T_rig_rect(self) -> Array:
        """From the rectified frame, in which the epipolar lines are columns, to the rig's own (4, 4)."""
        return se3.inverse(self.rig.T_rect_rig)

    def model(self, noise_px: float) -> StereoModel:
        """What turns points into views, for corners located with a deviation of noise_px."""
        return StereoModel(self.cylinder, self.rig.baseline_m, noise_px)


def geometry(rig: Rig, config: PanoramaConfig) -> Geometry:
    """The geometry of a rig; a camera without a mask counts as far as its image goes."""
    return Geometry(rig, fit_cylinder(rig, config.width_px, config.elevation_deg))


def with_rims(rig: Rig, frames: Iterable[Frame]) -> Rig:
    """The rig with the mirrors' rims where it has no masks, as seen in its first images; else as it is."""
    missing: list[Camera] = [name for name, camera in _cameras(rig).items() if camera.mask is None]
    if not missing:
        return rig
    found = _look(rig, missing, frames)
    return replace(rig, lower=_masked(rig.lower, found.get("lower")), upper=_masked(rig.upper, found.get("upper")))


def _cameras(rig: Rig) -> dict[Camera, MountedCamera]:
    return {"lower": rig.lower, "upper": rig.upper}


def _look(rig: Rig, missing: list[Camera], frames: Iterable[Frame]) -> dict[Camera, Mask]:
    """The rims in the brightest of the first images: one alone may be dark at some side."""
    decode, stream = Decoder(rig), iter(frames)
    brightest: dict[Camera, NDArray[np.uint8]] = {}
    found: dict[Camera, Mask] = {}
    for _ in range(LOOKS):
        for frame in islice(stream, FRAMES_A_LOOK):
            image = decode(frame)
            if image is not None:
                brightest[frame.camera] = np.maximum(brightest.get(frame.camera, image), image)
        for name in set(missing) & brightest.keys() - found.keys():
            rim = find_rim(brightest[name], _cameras(rig)[name].camera.center)
            if rim is not None:
                found[name] = rim
        if len(found) == len(missing):
            break
    return found


def _masked(camera: MountedCamera, mask: Mask | None) -> MountedCamera:
    return camera if mask is None else replace(camera, mask=mask)
