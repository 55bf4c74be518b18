"""Trajectory and map of a rendered log by omnid's own stages; with and without the Kalman filter of the motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.config import Config, OdometryConfig
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.motion_model import MotionModel
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.paper.paper_odometry import PaperOdometry
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.relocalisation import Relocaliser
from omnid.formats.tum import Trajectory
from omnid.settings import load
from omnid.stages.dense_depths import DenseStereo
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import Mapping
from omnid.stages.odometry import OdometryMethod
from tests.bench.paper.views import log_geometry, panoramas_of


@dataclass(frozen=True, slots=True)
class Method:
    """A way to estimate the motion: configuration overrides, and if the motion is filtered (paper, section IV.D)."""

    overrides: tuple[str, ...] = ()  # as of --set
    filtered: bool = True

    @property
    def config(self) -> Config:
        """The whole configuration."""
        return load(Config, overrides=self.overrides)


class PassThroughFilter(MotionFilter):
    """A motion filter that filters nothing: it predicts no motion and returns each measured motion as it is."""

    def predict(self, dt_s: float) -> Array:
        """Return the identity (4, 4): no motion is expected."""
        super().predict(dt_s)
        return np.eye(4)

    def update(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> Array:
        """Return the measured motion T_prev_curr (4, 4), with its rounding errors removed.

        The filter makes an exact rotation of its state. Without that, a rotation that is composed and inverted by its
        transpose would double its error with every pair.
        """
        super().update(T_prev_curr, covariance, dt_s)
        return se3.exp(se3.log(T_prev_curr))


class UnfilteredOdometry(VisualOdometry):
    """omnid's method without the filter; there it only predicts where the search for landmarks begins."""

    def __init__(self, geometry: Geometry, config: OdometryConfig) -> None:
        model = geometry.model(config.noise_px)
        super().__init__(model, config.klt, config.limits, Relocaliser(model))
        self._motion = MotionModel(config.limits, PassThroughFilter())


class UnfilteredPaperOdometry(PaperOdometry):
    """The paper's method without the filter, whose output is the motion that is composed."""

    def __init__(self, geometry: Geometry, config: OdometryConfig) -> None:
        super().__init__(geometry.model(config.noise_px), config.klt, config.tracker, config.reference)
        self._filter = PassThroughFilter()


def estimate(folder: Path, method: Method) -> tuple[Trajectory, MapPoints | None]:
    """Return the poses T_odom_rig, one for each pair, and the map; without the filter there is no map."""
    place, config = log_geometry(folder), method.config
    if not method.filtered:
        return _unfiltered(folder, place, config), None
    front_end = FrontEnd(place, config)
    mapping = Mapping(config.mapping, front_end.dense)
    stamps_ns, poses = [], []
    for panoramas in panoramas_of(folder, place):
        update = front_end.odometry.process(panoramas)
        mapping.process(update)
        stamps_ns.append(update.stamp_ns)
        poses.append(update.T_odom_rig)
    return Trajectory(np.array(stamps_ns), np.array(poses)), mapping.finish()[-1].points


def _unfiltered(folder: Path, place: Geometry, config: Config) -> Trajectory:
    is_paper = config.odometry.method == "paper"
    odometry: OdometryMethod = (UnfilteredPaperOdometry if is_paper else UnfilteredOdometry)(place, config.odometry)
    stamps_ns: list[int] = []
    poses = []
    stereo = DenseStereo(place, config.stereo_settings())
    for seen in panoramas_of(folder, place):
        frame = StereoFrame(seen.seq, seen.lower, seen.upper, stereo.compute(seen).disparity, seen.visible)
        dt_s = (seen.stamp_ns - stamps_ns[-1]) * 1e-9 if stamps_ns else 0.0
        T_odom_rect = odometry.process(frame, dt_s).T_odom_rect
        stamps_ns.append(seen.stamp_ns)
        poses.append(place.T_rig_rect @ T_odom_rect @ se3.inverse(place.T_rig_rect))
    return Trajectory(np.array(stamps_ns), np.array(poses))
