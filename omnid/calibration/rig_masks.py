"""Rig of a calibration with the masks of its cameras."""

from __future__ import annotations

from dataclasses import replace

from calib import se3
from calib.camera_file import CameraFile
from calib.fit.boards.rig_fit import RigCalibration
from calib.masks.rim import find_rim
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from calib.models.names import sees_directly
from calib.rig import Rig
from calib.rig_frame import rig_between
from omnid.calibration.image_pairs import SIDES, PairedImages
from omnid.calibration.images import Images, brightest


def masked_rig(
    found: RigCalibration, images: PairedImages, cameras: tuple[CameraFile, CameraFile] | None, *, with_struts: bool
) -> tuple[Rig, list[str]]:
    """Return the rig with its masks, and warnings about mirrors without a rim in the images.

    cameras: files of known cameras, whose masks are taken over.
    """
    rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower), images.topics)
    masks = [
        _mask(camera.center, side, file, with_struts=with_struts)
        for camera, side, file in zip((found.lower, found.upper), images.sides, cameras or (None, None), strict=True)
    ]
    mirrors = [
        name
        for name, camera, mask in zip(SIDES, (found.lower, found.upper), masks, strict=True)
        if mask is None and not sees_directly(camera)
    ]
    warnings = [
        f"no rim of a mirror was found in the {name} camera's images: the daemon searches for it at start, or add "
        f"[{name}.mask] by hand"
        for name in mirrors
    ]
    return replace(rig, lower=replace(rig.lower, mask=masks[0]), upper=replace(rig.upper, mask=masks[1])), warnings


def _mask(center: tuple[float, float], images: Images, file: CameraFile | None, *, with_struts: bool) -> Mask | None:
    """Return the mask with hub and struts, or that of the camera's file, or the rim in the maximum of all images."""
    if with_struts:
        return find_mask(list(images.values()), center)
    if file is not None and file.mask is not None:
        return file.mask
    return find_rim(brightest(images.values()), center)
