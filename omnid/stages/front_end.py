"""Front end of all runs: pairs of images, panoramas, check of the rig, odometry; and the dense depth of its pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.rig_uncertainty import motion_errors
from omnid.config import Config
from omnid.core.control.motion_monitor import AGREE, Conflict
from omnid.core.frames import BodyMotion
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.odometry.earlier_view import EarlierView
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.motion_agreement import Contradiction, MotionAgreement
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.rig_error import RigError
from omnid.core.places.recognition import Relocaliser
from omnid.core.rig.rig_health import RigHealth
from omnid.core.types.panorama import Panoramas
from omnid.engine.kernel_cache import prepare_kernels
from omnid.messages import FramePair, OdometryUpdate, StereoDepth
from omnid.stages.geometry import DenseDepths, Dewarp, Geometry, stereo_frame
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState

if TYPE_CHECKING:  # it takes a second, and few runs use it
    from omnid.core.odometry.paper.paper_odometry import PaperOdometry

Array = NDArray[np.float64]


class FrontEnd:
    """The stages from images to their pose: `pairing`, `dewarp`, and this one, which estimates poses from panoramas.

    Poses are in odom, which is the rig frame of the first pair, by a rig that is checked: the first pairs, and those
    after a loss, are checked by `health`. `dense` computes the dense depth of the pairs for all stages that need it.
    """

    def __init__(self, geometry: Geometry, config: Config, health: RigHealth | None = None) -> None:
        """health: state of the rig; None: a new one, with the check of the configuration.

        The first one compiles functions that no earlier program has compiled; OmnidError where they cannot be kept.
        """
        prepare_kernels()
        self.geometry = geometry
        self.health = health or RigHealth(geometry.cylinder, config.rig.check)
        self.pairing = Synchronise(geometry.rig, config.pair, config.motion.R_base_imu)
        self.dewarp = Dewarp(geometry, config.panorama)
        self.dense = DenseDepths(geometry, config.stereo_settings())
        self._T_rig_rect, self._T_base_rect = geometry.T_rig_rect, geometry.T_base_rect
        self._last_ns: int | None = None
        self._unchecked: StereoDepth | None = None  # the last pair, if it is to be checked with its motion
        self._keyframe: tuple[Panoramas, OdometryEstimate] | None = None  # the last one, if its pose was known well
        self.motion = MotionFilter(T_base_rect=self._T_base_rect)
        self._method: VisualOdometry | PaperOdometry
        settings = config.odometry
        model = geometry.model(settings.noise_px)
        if settings.method == "default":
            of_images = Relocaliser(model), self.dewarp.raw_images
            self._method = VisualOdometry(model, settings.klt, settings.limits, *of_images, self.motion)
        else:
            from omnid.core.odometry.paper.paper_odometry import PaperOdometry

            self._method = PaperOdometry(model, settings.klt, settings.tracker)
        self._agreement = MotionAgreement(self.motion)
        self.last_fault = AGREE  # the last disagreement that was more than a doubt
        self._contradiction = Contradiction()
        self._rig_error = RigError(motion_errors(geometry.rig))

    @property
    def conflict(self) -> Conflict:
        """The present disagreement of images, wheels and gyro."""
        return self._agreement.result

    @property
    def image_faults(self) -> list[str]:
        """One line for each way in which the images of a camera are torn or displaced."""
        breaks = self._method.breaks if isinstance(self._method, VisualOdometry) else None
        return [] if breaks is None else list(breaks.words.values())

    def process(self, pair: Panoramas) -> OdometryUpdate:
        """Return the pose at a pair; RigContradictedError where the images contradict the rig."""
        # 1. Check the rig by the pair; where the pixels were exposed at several times, by the pair before: the odometry
        #    has found the motion during its exposures.
        if pair.times.is_synchronised:
            self.health.check_first(pair)
        elif self._unchecked is not None:
            self.health.check_first(self._unchecked.panoramas, self._unchecked.exposure)
        is_contradicted, is_checking = self.health.state.is_contradicted, self.health.is_checking
        # 2. What wheels and gyro have measured since the pair before.
        last_ns, self._last_ns = self._last_ns, pair.stamp_ns
        sensors = self.motion.sensors
        sensors.add(pair.motion)
        dt_s, interval_s = 0.0, None
        if last_ns is not None:
            dt_s = (pair.stamp_ns - last_ns) * S_PER_NS
            interval_s = sensors.seconds(last_ns), sensors.seconds(pair.stamp_ns)
        # 3. The pose of the rectified frame.
        frame = stereo_frame(pair, lambda exposure: self.dense.points(pair, exposure).disparity, interval_s)
        estimate = self._method.process(frame, dt_s)
        # 4. Compare its step with wheels and gyro over seconds.
        if estimate.step is not None and last_ns is not None:
            seen = se3.adjoint(self._T_base_rect) @ se3.log(estimate.step)
            self._agreement.add_step(last_ns, pair.stamp_ns, *map(float, seen[[0, 5, 1]]))
            if self.conflict.is_fault:
                self.last_fault = self.conflict
        # 5. The message, at best degraded where the rig, darkness, or wheels and gyro contradict the pose.
        is_doubted = pair.light.is_too_dark or (self.conflict.is_fault and self.conflict.contradicts_images)
        state = estimate.state
        if state is TrackingState.TRACKING and (is_doubted or is_contradicted):
            state = TrackingState.DEGRADED
        update = self._update(pair, estimate, state)
        # 6. Whether the next pair is to be checked.
        self._unchecked = update.depth if is_checking and not pair.times.is_synchronised else None
        return update

    def complete(self) -> None:
        """Finish the work for the last pair now, such as its keyframe; otherwise that is done before the next pair."""
        self._method.complete()

    def pose(self, pair: FramePair) -> OdometryUpdate:
        """Return the pose at a pair of images: `dewarp` and `process`, for callers without a graph."""
        return self.process(self.dewarp.process(pair))

    def motion_stats(self) -> dict[str, object]:
        """Return samples of wheels and gyro, their estimated errors with sigmas, and the sensor that differs."""
        inbox, sensors, conflict = self.pairing.motion, self.motion, self.conflict
        # 1. What is wrong.
        warning = f"{conflict.reason} {conflict.detail}".strip()
        if not sensors.wheels_are_sane:
            what = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
            warning = f"{what}: {conflict.detail}" if conflict.detail else what
        elif sensors.is_slipping:
            warning = "wheels slip"
        # 2. The numbers.
        stats: dict[str, object] = {
            "wheel_samples": inbox.wheels,
            "gyro_samples": inbox.gyro,
            "dropped": inbox.dropped,
            "slips": sensors.slips,
            "refused_gyro": sensors.refused,
            "_warning": warning,
        }
        distance, turn, *bias = sensors.values.tolist()
        if inbox.wheels and sensors.steps:
            stats |= {"wheel_scale": distance, "turn_scale": turn}
        if inbox.gyro and sensors.steps:
            stats |= {f"gyro_bias_{axis}_radps": value for axis, value in zip("xyz", bias, strict=True)}
        return stats

    def _update(self, pair: Panoramas, estimate: OdometryEstimate, state: TrackingState) -> OdometryUpdate:
        """Return the message of an estimate, in the frame of the rig, with the errors of rig and sensors."""
        # 1. The uncertainty by what wheels and gyro contradict, and by the errors of the rig.
        T_odom_rect, T_rect_base = estimate.T_odom_rect, se3.inverse(self._T_base_rect)
        to_rect = se3.adjoint(T_rect_base)
        contradicted = self._contradiction.add(self.conflict, T_odom_rect @ T_rect_base, pair.stamp_ns * S_PER_NS)
        covariance_rect = estimate.covariance + to_rect @ contradicted @ to_rect.T
        covariance = covariance_rect + self._rig_error.at(T_odom_rect, estimate.distance_m)
        # 2. The depth, with what the camera saw at the last keyframe, where the motion since is known.
        is_known, before, earlier = estimate.state is TrackingState.TRACKING, self._keyframe, None
        if estimate.is_keyframe:
            self._keyframe = (pair, estimate) if is_known else None
        if before is not None and is_known and before[1].resets == estimate.resets:
            T_earlier_now = se3.inverse(before[1].T_odom_rect) @ T_odom_rect
            earlier = EarlierView(before[0].lower, before[0].usable, T_earlier_now, before[1].exposure)
        motion = BodyMotion(T_odom_rect, covariance, estimate.velocity, estimate.velocity_covariance)
        return OdometryUpdate(
            pair.seq,
            pair.stamp_ns,
            *motion.of(self._T_rig_rect),
            state,
            estimate.resets,
            estimate.inliers,
            estimate.tracked,
            StereoDepth(pair, estimate.exposure, earlier),
            estimate.features,
            estimate.is_keyframe,
            self.conflict,
            estimate.image_fault,
            T_odom_rect,
            covariance_rect,
        )
