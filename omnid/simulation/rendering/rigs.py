"""Rigs of two cameras that face up into mirrors, with given misalignments."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig

# Radii of the horizon at scale 1 and of the mirror's rim, in parts of the image's width.
HORIZON = 207.5676 / 768
RIM = 373.0 / 768
TOPICS = ("/lower/image_raw/compressed", "/upper/image_raw/compressed")
# The image's centre shows the floor; up in the image is forward, and the mirror's flip is in fu < 0.
R_RIG_CAM = np.array([[0, -1.0, 0], [-1, 0, 0], [0, 0, -1]])


def make_rig(
    *,
    size: int = 768,
    scale: float = 1.0,
    baseline_m: float = 0.2,
    rim: float = RIM,
    xi: float = 1.0,
    misaligned_deg: tuple[float, float, float] = (0, 0, 0),
    offset_mm: tuple[float, float] = (0, 0),
    lower_misaligned_deg: tuple[float, float, float] = (0, 0, 0),
    lower_offset_mm: tuple[float, float] = (0, 0),
    distortion: tuple[float, float, float, float] = (0, 0, 0, 0),
    centre_px: tuple[float, float] = (0, 0),
) -> Rig:
    """Return a rig with its frame at the lower viewpoint, z up, unless lower_* are given.

    misaligned_deg: rotation vector of the upper camera, in the rig frame, about its viewpoint, which lies offset_mm
    (x, y) off the axis. scale: horizon radius; rim: mirror radius as fraction of size; centre_px moves the optical
    centre (and the rim) off the image's centre.
    """
    focal = HORIZON * size * scale * (xi if xi > 0 else 1.0)
    centre = ((size - 1) / 2 + centre_px[0], (size - 1) / 2 + centre_px[1])
    camera = UnifiedCamera(xi, (-focal, focal), centre, (size, size), distortion)
    mask = Mask(centre, 0.0, rim * size)
    lower = MountedCamera(camera, camera_pose(lower_misaligned_deg, (*lower_offset_mm, 0.0)), mask)
    upper = MountedCamera(camera, camera_pose(misaligned_deg, (*offset_mm, 1e3 * baseline_m)), mask)
    return Rig(lower, upper, topics=TOPICS)


def camera_pose(misaligned_deg: tuple[float, float, float], viewpoint_mm: tuple[float, float, float]) -> Array:
    """Return T_cam_rig (4, 4) of a camera that is turned about its viewpoint."""
    R = se3.rotation_exp(np.deg2rad(misaligned_deg)) @ R_RIG_CAM
    return se3.inverse(se3.transform(R, 1e-3 * np.array(viewpoint_mm)))
