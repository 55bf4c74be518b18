"""Observations of a drive: pixels of landmarks in both cameras, and the poses and landmarks that explain them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models import wavefront as wavefronts
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import DISTANCE_M, OcamCamera
from calib.rig import Rig

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class KeyframeMotion:
    """Motion of the rig at each keyframe, by which an exposure at another time is predicted."""

    twist: Array  # (K, 6) [m/s, rad/s] of the rig, in its own frame
    upper_delay_s: Array  # (K,) upper stamp minus lower stamp

    @staticmethod
    def still(keyframes: int) -> KeyframeMotion:
        """Return the motion of keyframes whose images show one instant."""
        return KeyframeMotion(np.zeros((keyframes, 6)), np.zeros(keyframes))


@dataclass(frozen=True, slots=True)
class DriveObservations:
    """Pixels (M, 2) in the cameras' images (camera 0 lower, 1 upper) of landmarks, seen from keyframes."""

    keyframe: Indices  # (M,)
    landmark: Indices  # (M,)
    camera: Indices  # (M,)
    pixels: Array  # (M, 2)

    def __len__(self) -> int:
        return len(self.landmark)

    def only(self, kept: Flags) -> tuple[DriveObservations, Indices]:
        """Return the chosen observations with landmarks numbered again, and the old numbers of those."""
        used, landmark = np.unique(self.landmark[kept], return_inverse=True)
        return DriveObservations(self.keyframe[kept], landmark, self.camera[kept], self.pixels[kept]), used


@dataclass(frozen=True, slots=True)
class DriveState:
    """Poses of the keyframes at the lower camera's stamps, landmarks in odom, steps of the rig's parameters."""

    T_rig_odom: Array  # (K, 4, 4)
    points: Array  # (L, 3) m
    steps: Array  # (P,)
    motion: KeyframeMotion


def project(rig: Rig, camera: Indices, points: Array, waves: Array | None = None) -> Array:
    """Return pixels (M, 2) of points (M, 3) in the rig frame, each in its camera; NaN where there is no image.

    waves: wavefronts (2, 5) [m] of both cameras, None: central cameras. The cameras themselves are exact at DISTANCE_M.
    """
    pixels = np.full((len(points), 2), np.nan)
    for side, mounted in enumerate((rig.lower, rig.upper)):
        at = np.flatnonzero(camera == side)
        if len(at):
            seen = se3.apply(mounted.T_cam_rig, points[at])
            if waves is not None and np.any(waves[side]):
                seen = _at_distance(mounted.camera, seen, tuple(waves[side].tolist()))
            pixels[at] = mounted.camera.project(seen)
    return pixels


def _at_distance(camera: OmniCamera, points: Array, wavefront: tuple[float, ...]) -> Array:
    """Return the places (N, 3), at the distance for which a camera is exact, of the rays to points (N, 3) [m]."""
    axis = float(np.sign(camera.lift(np.array([camera.center]))[0, 2]))
    distance_m = camera.distance_m if isinstance(camera, OcamCamera) else DISTANCE_M
    return wavefronts.points_at(distance_m, wavefronts.directions_to(points, wavefront, axis), wavefront, axis)
