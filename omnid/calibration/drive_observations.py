"""Keyframes and landmarks of a drive, as observations in the cameras' images: odometry with the rig as it is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from calib import se3
from calib.fit.rig_from_drive import DriveObservations, DriveState
from calib.models.camera import Array
from calib.rig import Rig
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.config import Config
from omnid.core.rig.drive_landmarks import DriveLandmarks, in_images
from omnid.core.rig.rig_health import RigHealth, RigState
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry
from omnid.tracking_state import TrackingState

KEYFRAME_M, KEYFRAME_RAD = 0.12, np.deg2rad(8)
MAX_KEYFRAMES = 80  # On long drives they are farther apart.
MIN_KEYFRAMES = 15


def collect(log: Path, rig: Rig, cameras: LogCameras) -> tuple[DriveState, DriveObservations]:
    """Return keyframes of a drive with its landmarks, without steps of the rig, and their pixels in the images.

    OmnidError where it is too short.
    """
    config = Config()
    place = geometry(rig, config.panorama)
    front_end = FrontEnd(place, config, RigHealth(place.cylinder, "warn"))
    landmarks = DriveLandmarks(place.model(config.odometry.noise_px))
    T_rig_odom, twists, delays_s = list[Array](), list[Array](), list[float]()
    since = 0  # pairs since the last keyframe
    with closing(LogReader(log, cameras, place.rig.topics)) as reader:
        min_pairs = max(1, -(-(reader.pair_estimate() or 0) // MAX_KEYFRAMES))
        for update in tracked_updates(reader, front_end, log):
            # 1. Choose the poses that are far enough apart to add information.
            T_odom_rig, since = update.T_odom_rig, since + 1
            if T_rig_odom:
                moved = se3.log(T_rig_odom[-1] @ T_odom_rig)
                still = np.linalg.norm(moved[:3]) < KEYFRAME_M and np.linalg.norm(moved[3:]) < KEYFRAME_RAD
                if still or since < min_pairs or update.state is TrackingState.LOST:
                    continue
            since = 0
            # 2. Follow the landmarks to this keyframe.
            seen, disparity = update.depth.panoramas, front_end.dense.of(update.depth).disparity
            landmarks.add(seen, disparity, T_odom_rig @ place.T_rig_rect)
            T_rig_odom.append(se3.inverse(T_odom_rig))
            # 3. Its motion, which predicts the views at other times of exposure.
            twists.append(update.velocity)
            # Upper minus lower stamp; the rig's delay of the exposures is a parameter of its own.
            delays_s.append(seen.times.skew_s - place.rig.times.upper_delay_s)
    if len(T_rig_odom) < MIN_KEYFRAMES:
        raise OmnidError(
            f"calibrate drive: only {len(T_rig_odom)} views {KEYFRAME_M} m or "
            f"{np.rad2deg(KEYFRAME_RAD):.0f} deg apart, {MIN_KEYFRAMES} are needed; take a longer drive"
        )
    # 4. The observations in the images.
    observations, points = in_images(*landmarks.observations(), place.rig, place.cylinder)
    state = DriveState(np.array(T_rig_odom), points, np.array(twists), np.array(delays_s), np.zeros(0))
    return state, observations


def tracked_updates(reader: LogReader, front_end: FrontEnd, log: Path) -> Iterator[OdometryUpdate]:
    """Yield the poses of a log; OmnidError where the rig cannot be that of its cameras."""
    pairing, health = front_end.pairing, front_end.health
    for pair in filter(None, map(pairing.process, reader.frames())):
        update = front_end.pose(pair)
        if health.state is RigState.EXCHANGED:
            raise OmnidError(f"{log}: {health.warning}")
        yield update
