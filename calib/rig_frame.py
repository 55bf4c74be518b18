"""Construction of a rig from two cameras and the transform between them."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.names import sees_directly
from calib.rig import MIN_BASELINE_M, MountedCamera, Rig

# Sine and cosine of the largest lean of what is below in an image from the baseline, 45 degrees, because that is
# half-way to a camera that lies on its side.
MAX_LEAN = np.sqrt(0.5)


def rig_between(lower: OmniCamera, upper: OmniCamera, T_lower_upper: Array, topics: tuple[str, str] = ("", "")) -> Rig:
    """Return the rig with its frame at the lower viewpoint: z to the upper one, x ahead (REP 103).

    Ahead is the part across z of the mean optical axis, if the cameras look to the side. Of cameras that look along z,
    as mirrors and fisheyes that see all around, x is the lower image's u axis.
    """
    baseline = float(np.linalg.norm(se3.t_of(T_lower_upper)))
    if not baseline >= MIN_BASELINE_M:
        raise CalibError(f"rig: the viewpoints must lie apart, found {baseline * 1e3:.3f} mm between them")
    z = se3.t_of(T_lower_upper) / baseline
    u, v = image_axis(lower, (1.0, 0.0)), image_axis(lower, (0.0, 1.0))
    axes = optical_axis(lower), se3.R_of(T_lower_upper) @ optical_axis(upper)
    forward = (axes[0] + axes[1]) / 2
    if np.linalg.norm(forward - z * (z @ forward)) < MAX_LEAN:
        forward = u if abs(z @ u) < 0.9 else v
    x = forward - z * (z @ forward)
    x /= np.linalg.norm(x)
    T_lower_rig = se3.transform(np.column_stack([x, np.cross(z, x), z]), np.zeros(3))
    T_upper_rig = se3.inverse(T_lower_upper) @ T_lower_rig
    return Rig(MountedCamera(lower, T_lower_rig), MountedCamera(upper, T_upper_rig), topics=topics)


def is_turned_over(rig: Rig) -> bool:
    """True if the upper viewpoint lies below the lower one, unless the cameras are mounted upside down.

    A camera below its mirror sees itself below it, and below its horizon an upright camera that looks ahead sees the
    lower part of its image. A lens that looks along the baseline may look up or down: False.
    """
    camera, z = rig.lower.camera, rig.lower.T_cam_rig[:3, 2]
    below = image_axis(camera, (0.0, 1.0)) if sees_directly(camera) else optical_axis(camera)
    return bool(z @ below > MAX_LEAN)


def mounting_notes(rig: Rig) -> list[str]:
    """Return warnings about a rig that is turned over, or whose cameras stand side by side."""
    if is_turned_over(rig):
        mounted = "stand upside down" if sees_directly(rig.lower.camera) else "look down into their mirrors"
        return [
            f"the upper camera is found below the lower one: exchange their images, unless the cameras {mounted}; "
            "the rig's z would point down"
        ]
    along = rig.lower.T_cam_rig[:3, 2] @ image_axis(rig.lower.camera, (1.0, 0.0))
    if abs(along) > MAX_LEAN:
        return [
            "the cameras are found side by side, along the rows of their images: one must stand above the other, "
            "unless both lie on their sides; the rig's z would point to the side"
        ]
    return []


def optical_axis(camera: OmniCamera) -> Array:
    """Return the unit ray (3,) of the image's centre in the camera frame."""
    return np.asarray(camera.lift(np.array([camera.center]))[0])


def image_axis(camera: OmniCamera, step_px: tuple[float, float]) -> Array:
    """Return the unit vector (3,) in the camera frame that corresponds to a step in pixels at the image's centre."""
    ends = camera.lift(np.array([np.subtract(camera.center, step_px), np.add(camera.center, step_px)]))
    axis = ends[1] - ends[0]
    if not np.isfinite(axis).all():
        raise CalibError("rig: the lower camera's model has no ray next to its centre; check its intrinsics")
    return np.asarray(axis / np.linalg.norm(axis))
