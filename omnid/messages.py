"""What flows between the stages. p_a = T_a_b @ p_b; SI units; NaN for unknown; nobody writes into a message."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.odometry.stereo_frame import Features
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Images of both cameras at one instant; the stamp is the lower camera's."""

    seq: int
    stamp_ns: int
    lower: NDArray[np.uint8]  # (H, W)
    upper: NDArray[np.uint8]  # (H, W)


@dataclass(frozen=True, slots=True, eq=False)
class Panoramas:
    """Both images on the cylinder about the line through the viewpoints: epipolar lines are columns."""

    seq: int
    stamp_ns: int
    lower: PaddedPanorama
    upper: PaddedPanorama
    visible: NDArray[np.bool_]  # (H, W) both cameras show the world here, and in a tracking window around


@dataclass(frozen=True, slots=True, eq=False)
class StereoDepth:
    """Disparities of the lower panorama, and the points they stand for."""

    seq: int
    stamp_ns: int
    panoramas: Panoramas
    disparity: NDArray[np.float32]  # (H, W) px > 0, NaN unknown
    pixels: Array  # (N, 2) column, row of the located pixels
    points: Array  # (N, 3) m, in the rig frame
    variance_m2: Array  # (N,) along the ray, where it is largest


@dataclass(frozen=True, slots=True, eq=False)
class OdometryUpdate:
    """The rig's pose, its uncertainty and motion, and the depth it came from."""

    seq: int
    stamp_ns: int
    T_odom_rig: Array  # (4, 4)
    covariance: Array  # (6, 6) of the pose, x y z rx ry rz in odom axes, m^2 and rad^2
    velocity: Array  # (6,) m/s, rad/s in the rig frame
    velocity_covariance: Array  # (6, 6)
    state: TrackingState
    reset_counter: int  # how often odom had to start anew with an unknown gap
    inliers: int  # landmarks that agree with the pose
    tracks: int  # landmarks that were found
    depth: StereoDepth
    features: Features = field(default_factory=Features)  # for whoever looks on; the paper's method gives none


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The map as it stands, and the way there."""

    seq: int
    stamp_ns: int
    points: MapPoints  # m, in the rig frame of the first pair
    path_xy: Array  # (N, 2) m, likewise, thinned where the run is long
