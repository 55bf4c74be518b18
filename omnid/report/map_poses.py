"""The poses in the map of a recording, compared with those of odometry."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.formats.tum import POSITION_LIMIT_M
from omnid.report.downsampling import Corner, Downsampled, path_trace
from omnid.transport.decode import PoseInMap
from omnid.transport.records import OdometryRecord

Array = NDArray[np.float64]

_WAITING: Final = 256  # poses of odometry that wait for that in the map: it comes from a stage behind
_NO_STATE: Final = 0


class MapPoseHistory:
    """Collects the path in the map, and the correction map -> odom; times are in s since the first pose."""

    def __init__(self) -> None:
        self._odometry: OrderedDict[int, Array] = OrderedDict()
        self.path = path_trace()
        self.moved_m, self.turned_deg = Downsampled(), Downsampled()
        self.sigma_m = Downsampled()

    def add_odometry(self, record: OdometryRecord) -> None:
        """Keep a pose of odometry until that in the map comes."""
        self._odometry[record.stamp_ns] = record.T_odom_base
        if len(self._odometry) > _WAITING:
            self._odometry.popitem(last=False)

    def add(self, pose: PoseInMap, t_s: float) -> None:
        """Add a pose in the map; one without a pose of odometry of its stamp is left out."""
        T_odom_base = self._odometry.pop(pose.stamp_ns, None)
        position = pose.T_map_base[:3, 3]
        if T_odom_base is None or not (np.abs(position) <= POSITION_LIMIT_M).all():
            return
        self.path.add(Corner(float(position[0]), float(position[1]), t_s, _NO_STATE))
        # The pose in the map relative to that of odometry: the part of map -> odom that is seen at the robot.
        self.moved_m.add(t_s, float(np.linalg.norm(position[:2] - T_odom_base[:2, 3])))
        turned = float(se3.yaw(pose.T_map_base @ se3.inverse(T_odom_base)))
        self.turned_deg.add(t_s, math.degrees(turned))
        variance = float(np.diag(pose.covariance)[:3].sum())
        self.sigma_m.add(t_s, math.sqrt(variance) if variance > 0 else math.nan)
