"""Messages between the stages. p_a = T_a_b @ p_b; SI units; NaN for unknown; messages are not modified."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.frame import Frame
from drivers.jpeg import Steps
from drivers.motion import MotionSample
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.motion_monitor import AGREE, Conflict
from omnid.core.frames import BodyMotion
from omnid.core.mapping.scan_grid import Grid, KeyframeScans
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.navigation.requests import NavigationState, TaughtRoute
from omnid.core.obstacles.grid import FloorGrid
from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.core.odometry.earlier_view import EarlierView
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.stereo_frame import Features
from omnid.core.types.panorama import Panoramas
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Images of both cameras at nearly one instant; the stamp is the lower camera's."""

    seq: int
    stamp_ns: int
    lower: NDArray[np.uint8]  # (H, W)
    upper: NDArray[np.uint8]  # (H, W)
    skew_s: float = 0.0  # upper minus lower exposure
    motion: tuple[MotionSample, ...] = ()  # samples of wheels and gyro since the last pair
    jpeg_steps: tuple[Steps, Steps] = ((), ())  # of the quantisation of both JPEGs (drivers.jpeg), (): none
    frames: tuple[Frame, ...] = ()  # frames from which the images were decoded


@dataclass(frozen=True, slots=True, eq=False)
class DensePoints:
    """Disparities of a lower panorama and their points."""

    disparity: NDArray[np.float32]  # (H, W) px > 0, NaN unknown
    pixels: Array  # (N, 2) column, row of the matched pixels
    points: Array  # (N, 3) m, in the rig frame
    variance_m2: Array  # (N,) along the ray, where it is largest


@dataclass(frozen=True, slots=True, eq=False)
class StereoDepth:
    """Evidence of the depth of a pair: `stages.geometry.DenseDepths` computes the dense depth from it."""

    panoramas: Panoramas
    # The motion during the exposures, for which the depth is corrected; None: not known.
    exposure: Exposure | None = None
    # What the camera saw at the last keyframe; None: there was none, or the motion since then is not known well.
    earlier: EarlierView | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class OdometryUpdate:
    """Pose and velocity of the rig with covariances, and the depth they were estimated from."""

    seq: int
    stamp_ns: int
    T_odom_rig: Array  # (4, 4)
    covariance: Array  # (6, 6) of the pose, [t; r] in the axes of the rig, m^2 and rad^2
    velocity: Array  # (6,) m/s, rad/s in the rig frame
    velocity_covariance: Array  # (6, 6)
    state: TrackingState
    reset_counter: int  # how often odom was continued after a gap of unknown motion
    inliers: int  # landmarks that agree with the pose
    tracks: int  # landmarks that were tracked
    depth: StereoDepth
    features: Features = field(default_factory=Features)  # shown by viewers; empty with the method of the paper
    is_keyframe: bool = False  # odometry needs its dense depth in any case
    conflict: Conflict = AGREE  # whether images, wheels and gyro show the same motion
    image_fault: str = ""  # fault of torn or displaced images of a camera; empty: none
    T_odom_rect: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) the same pose, as it was estimated
    # covariance of T_odom_rect, [t; r] in the rectified axes, without the errors of the rig
    covariance_rect: Array = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def position(self) -> Array:
        """Position (3,) of the rig in odom, m: the last column of T_odom_rig."""
        return self.T_odom_rig[:3, 3]

    def of_base(self, T_base_rig: Array) -> BodyMotion:
        """Return the motion of the base that carries the rig."""
        return BodyMotion(self.T_odom_rig, self.covariance, self.velocity, self.velocity_covariance).of(T_base_rig)


@dataclass(frozen=True, slots=True, eq=False)
class MapKeyframes:
    """The keyframes of the map as they are at a pose, by id in ascending order: copies, because the map changes."""

    stamps_ns: Mapping[int, int]
    T_map_rect: Mapping[int, Array]  # (4, 4) of the rectified frame


@dataclass(frozen=True, slots=True, eq=False)
class PlaceUpdate:
    """Pose in the map after a pair: odom stays smooth, and T_map_odom carries the corrections (REP 105)."""

    seq: int
    stamp_ns: int
    T_map_odom: Array  # (4, 4) map and odom are rig frames, both that of the first pair at the start
    T_map_rig: Array  # (4, 4)
    covariance: Array  # (6, 6) of T_map_rig, [t; r] in the axes of the rig, m^2 and rad^2
    state: MapState
    keyframe: int = -1  # id of the keyframe to which the pose belongs; -1: none
    T_keyframe_rig: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) in it, by odometry
    # scans of the part of the map in which the pose is; the same object until they change
    scans: KeyframeScans | None = None
    keyframes: MapKeyframes | None = None  # the same object while the map stays
    # False: in a saved map or after a gap no place has been recognised yet, so it is unknown where odom lies in the map
    is_known: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class GridUpdate:
    """Occupancy grid of the map, in the axes of the base at its start."""

    seq: int  # number of the newest pair that it contains
    stamp_ns: int
    grid: Grid


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleScan:
    """Nearest obstacle in each direction from the base: sector k is about azimuth -pi + (k + 0.5) 2 pi / 360.

    Ranges are from the base's origin, in the plane of its x (forward) and y (left). Unknown is not free:
    stereo measures nothing on a plain surface.
    """

    seq: int
    stamp_ns: int
    ranges_m: NDArray[np.float32]  # (360,) inf: seen to be free up to obstacles.scan.max_range_m; NaN: unknown
    sigma_m: NDArray[np.float32]  # (360,) NaN where there is no range
    free_m: NDArray[np.float32]  # (360,) up to which the floor, or something behind, was seen; 0: nothing was
    T_odom_base: Array  # (4, 4)
    moving: tuple[MovingObstacle, ...] = ()
    # (360,) the images show nothing to rely on there: a part of them is frozen, dark, saturated or blurred
    unobserved: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(360, bool))
    grid: FloorGrid | None = None  # the cells around the base; None: the floor or the pose is unknown, or none in view


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The map so far, and the path of the rig."""

    seq: int
    stamp_ns: int
    points: MapPoints  # m, in the rig frame of the first pair
    path_xy: Array  # (N, 2) m, in the same frame, thinned in a long run


class RequestAnswer(NamedTuple):
    """Answer to a request to the navigation."""

    id: int  # id of the request; 0: none was sent, the recording of a route has ended by itself
    request: str  # one word
    refusal: str  # the reason, with the remedy; empty: it is accepted


@dataclass(frozen=True, slots=True, eq=False)
class NavigationPlan:
    """The path that is driven."""

    frame: str  # map or odom
    xy: Array  # (N, 2) m
    heading_rad: float | None  # heading at the end; None: any


@dataclass(frozen=True, slots=True, eq=False)
class NavigationUpdate:
    """State of the navigation after a pose or a request, and the motion that it wants."""

    seq: int
    stamp_ns: int
    setpoint: Setpoint | None  # heading in odom; None: nothing is sent, and the wheels stop
    state: NavigationState
    reason: str = ""  # reason of a stop or an end, in words
    task: str = ""  # such as "goal" or "route NAME"
    command_ns: int = 0  # stamp of the request that it follows from
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # distance of the base to the left of the path
    loops_left: int = 0  # rounds of a route that are left, this one included
    teaching: str = ""  # name of the route that is recorded
    taught_m: float = 0.0  # its length so far
    taught: TaughtRoute | None = None  # the newest route that is to be written; the same object until the next one
    answer: RequestAnswer | None = None  # to the newest request; None: there was none
    plan: NavigationPlan | None = None  # None where the plan is that of the message before
