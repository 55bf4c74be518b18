"""Geometry of a run: the rig with its masks, the cylinder of the panoramas, and the rectified frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder, fit_cylinder
from calib.rig import MountedCamera, Rig
from calib.rim import find_rim
from drivers.frame import Camera, Frame
from omnid.config import PanoramaConfig
from omnid.core.types.stereo_model import StereoModel
from omnid.stages.synchronise import Decoder

Array = NDArray[np.float64]

FRAMES = 12  # of both cameras, in the maximum of which the rims are looked for


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A rig whose masks are known, and the panorama that fits it."""

    rig: Rig
    cylinder: Cylinder

    @property
    def T_rig_rect(self) -> Array:
        """Transform (4, 4) from the rectified frame, in which epipolar lines are columns, to the rig frame."""
        return se3.inverse(self.rig.T_rect_rig)

    def model(self, noise_px: float) -> StereoModel:
        """Return the measurement model of corners located with a standard deviation of noise_px."""
        return StereoModel(self.cylinder, self.rig.baseline_m, noise_px)


def geometry(rig: Rig, config: PanoramaConfig) -> Geometry:
    """Return the geometry of a rig; a camera without a mask shows what MountedCamera.visible says."""
    return Geometry(rig, fit_cylinder(rig, config.width_px, config.elevation_deg, config.scale))


def with_rims(rig: Rig, frames: Iterable[Frame]) -> Rig:
    """Return the rig with masks of the mirrors' rims, found in the first images of cameras without a mask.

    A rim is sought in the maximum of the images: a single one may be dark on one side.
    """
    mounted: dict[Camera, MountedCamera] = {"lower": rig.lower, "upper": rig.upper}
    missing = [name for name, camera in mounted.items() if camera.mask is None]
    decode, brightest = Decoder(rig), dict[Camera, NDArray[np.uint8]]()
    for frame in islice(frames, FRAMES if missing else 0):
        image = decode(frame)
        if image is not None:
            brightest[frame.camera] = np.maximum(brightest.get(frame.camera, image), image)
    for name in missing:
        rim = find_rim(brightest[name], mounted[name].camera.center) if name in brightest else None
        mounted[name] = replace(mounted[name], mask=rim)
    return replace(rig, lower=mounted["lower"], upper=mounted["upper"]) if brightest else rig
