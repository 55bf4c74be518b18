"""Keyframes and landmarks of drives, as observations in the cameras' images: odometry with the rig as it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.rig_from_drive import DriveObservations, DriveState
from calib.rig import Rig
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.config import Config
from omnid.core.rig.drive_landmarks import DriveLandmarks, in_images
from omnid.core.rig.rig_health import RigHealth, RigState
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

KEYFRAME_M, KEYFRAME_RAD = 0.12, np.deg2rad(8)
MAX_KEYFRAMES = 80  # Most keyframes of all drives: on long drives they are farther apart.
MIN_KEYFRAMES = 15


@dataclass(frozen=True, slots=True)
class Drives:
    """Keyframes of all drives, their landmarks, and what was seen of them."""

    state: DriveState  # without steps of the rig
    observations: DriveObservations
    fixed: tuple[int, ...]  # the first keyframe of each drive

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.state.T_rig_odom)


def collect(logs: Sequence[Path], rig: Rig, cameras: LogCameras, config: Config) -> Drives:
    """Return the observations of drives; OmnidError where they are too short."""
    place = geometry(rig, config.panorama)
    parts = [_drive(log, place, cameras, config, MAX_KEYFRAMES // len(logs)) for log in logs]
    states, seen = [part.state for part in parts], [part.observations for part in parts]
    keyframes = np.cumsum([0, *(part.keyframes for part in parts)])
    landmarks = np.cumsum([0, *(len(state.points) for state in states)])
    T_rig_odom = np.concatenate([state.T_rig_odom for state in states])
    if len(T_rig_odom) < MIN_KEYFRAMES:
        raise OmnidError(
            f"calibrate drive: only {len(T_rig_odom)} views {KEYFRAME_M} m or "
            f"{np.rad2deg(KEYFRAME_RAD):.0f} deg apart, {MIN_KEYFRAMES} are needed; take a longer drive"
        )
    observations = DriveObservations(
        np.concatenate([part.keyframe + first for part, first in zip(seen, keyframes, strict=False)]),
        np.concatenate([part.landmark + first for part, first in zip(seen, landmarks, strict=False)]),
        np.concatenate([part.camera for part in seen]),
        np.concatenate([part.pixels for part in seen]),
    )
    points, twist, upper_delay_s = (
        np.concatenate([getattr(state, name) for state in states]) for name in ("points", "twist", "upper_delay_s")
    )
    state = DriveState(T_rig_odom, points, twist, upper_delay_s, np.zeros(0))
    return Drives(state, observations, tuple(keyframes[:-1].tolist()))


def _drive(log: Path, place: Geometry, cameras: LogCameras, config: Config, most: int) -> Drives:
    """Return keyframes of one drive, at most the given number, its landmarks, and their pixels in the images."""
    front_end = FrontEnd(place, config, RigHealth(place.cylinder, "warn"))
    landmarks = DriveLandmarks(place.model(config.odometry.noise_px))
    T_rig_odom, twists, delays_s = list[Array](), list[Array](), list[float]()
    since = 0
    with closing(LogReader(log, cameras, place.rig.topics)) as reader:
        # Least number of pairs between two keyframes, so that there are `most` at most.
        apart = max(1, -(-(reader.pair_estimate() or 0) // most))
        for update in tracked_updates(reader, front_end, config, log):
            # 1. Choose the poses that are far enough apart to add information.
            T_odom_rig, since = update.T_odom_rig, since + 1
            if T_rig_odom:
                moved = se3.log(T_rig_odom[-1] @ T_odom_rig)
                still = np.linalg.norm(moved[:3]) < KEYFRAME_M and np.linalg.norm(moved[3:]) < KEYFRAME_RAD
                if still or since < apart or update.state is TrackingState.LOST:
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
    # 4. The observations in the images.
    observations, points = in_images(*landmarks.observations(), place.rig, place.cylinder)
    state = DriveState(np.array(T_rig_odom), points, np.array(twists), np.array(delays_s), np.zeros(0))
    return Drives(state, observations, (0,))


def tracked_updates(reader: LogReader, front_end: FrontEnd, config: Config, log: Path) -> Iterator[OdometryUpdate]:
    """Yield the poses of a log; OmnidError where the rig cannot be that of its cameras."""
    pairing, health = Synchronise(front_end.geometry.rig, config.pair), front_end.health
    for pair in filter(None, map(pairing.process, reader.frames())):
        update = front_end.pose(pair)
        if health.state is RigState.EXCHANGED:
            raise OmnidError(f"{log}: {health.warning}")
        yield update
