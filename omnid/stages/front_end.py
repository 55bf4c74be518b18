"""Front end of all runs: pairs of images, panoramas, check of the rig, odometry; and the dense depth of its pairs."""

from __future__ import annotations

from dataclasses import replace

from omnid.config import Config
from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, GYRO_OFFSET, TURN, WHEEL_OFFSET
from omnid.core.rig.rig_health import RigHealth
from omnid.messages import FramePair, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry
from omnid.stages.odometry import OdometryStage
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState


class FrontEnd:
    """The stages from images to their pose, with the settings of one configuration.

    A run has `pairing`, `dewarp` and `poses` as stages; `process` does the work of the last two. `dense` computes the
    dense depth of their pairs for all stages that need it.
    """

    def __init__(self, geometry: Geometry, config: Config, health: RigHealth | None = None) -> None:
        """health: state of the rig; None: a new one, with the check of the configuration."""
        self.geometry = geometry
        self.health = health or RigHealth(geometry.cylinder, config.rig.check)
        self.pairing = Synchronise(geometry.rig, config.pair, config.motion.R_base_imu)
        self.dewarp = Dewarp(geometry, config.panorama)
        self.dense = DenseDepths(geometry, config.stereo_settings())
        self.odometry = OdometryStage(geometry, config.odometry, self.dense, self.dewarp.raw_images)
        self.poses = CheckedOdometry(self.odometry, self.health)

    def motion_stats(self) -> dict[str, object]:
        """Return samples of wheels and gyro, their estimated errors with sigmas, and the sensor that differs."""
        inbox, sensors, conflict = self.pairing.motion, self.odometry.motion, self.odometry.conflict
        stats: dict[str, object] = {
            "wheel_samples": inbox.wheels,
            "gyro_samples": inbox.gyro,
            "dropped": inbox.dropped,
            "slips": sensors.slips,
            "refused_gyro": sensors.refused,
            "_warning": "wheels slip" if sensors.is_slipping else f"{conflict.reason} {conflict.detail}".strip(),
        }
        if not sensors.wheels_are_sane:
            what = "wheels contradict the cameras: check motor.drive (radius, track, reversed, swapped)"
            stats["_warning"] = f"{what}: {conflict.detail}" if conflict.detail else what
        estimated: dict[str, tuple[int, float]] = {}  # state of the filter, and the unit
        if sensors.steps and inbox.wheels:
            estimated |= {"wheel_scale": (DISTANCE, 1.0), "turn_scale": (TURN, 1.0)}
            estimated |= {"wheel_offset_ms": (WHEEL_OFFSET, 1e3)}
        if sensors.steps and inbox.gyro:
            estimated |= {"gyro_offset_ms": (GYRO_OFFSET, 1e3)}
            estimated |= {f"gyro_bias_{axis}_radps": (BIAS.start + k, 1.0) for k, axis in enumerate("xyz")}
        stats |= {name: unit * float(sensors.values[state]) for name, (state, unit) in estimated.items()}
        return stats | {f"{name}_sigma": unit * float(sensors.sigmas[k]) for name, (k, unit) in estimated.items()}

    def process(self, pair: FramePair) -> OdometryUpdate:
        """Return the pose at a pair."""
        return self.poses.process(self.dewarp.process(pair))


class CheckedOdometry:
    """Odometry of a rig that its images do not contradict: the first pairs, and those after a loss, are checked."""

    def __init__(self, odometry: OdometryStage, health: RigHealth) -> None:
        self._odometry, self._health = odometry, health
        self._unchecked: StereoDepth | None = None  # the last pair, if it is to be checked with its motion
        self._was_found = False  # whether a pose was tracked yet

    def process(self, panoramas: Panoramas) -> OdometryUpdate:
        """Return the pose at a pair; RigContradictedError where the images contradict the rig."""
        # 1. Check the rig by the pair; where the pixels were exposed at several times, by the pair before: the odometry
        #    has found the motion during its exposures.
        if panoramas.times.is_at_once:
            self._health.begin(panoramas)
        elif self._unchecked is not None:
            self._health.begin(self._unchecked.panoramas, self._unchecked.exposure)
        is_contradicted, is_checking = self._health.state.is_contradicted, self._health.is_checking

        # 2. Estimate the pose. With a rig that the images contradict it is degraded at best.
        update = self._odometry.process(panoramas)
        self._unchecked = update.depth if is_checking and not panoramas.times.is_at_once else None
        self._was_found |= update.state is TrackingState.TRACKING
        if self._was_found and update.state is TrackingState.LOST:
            self._health.check_again()
        if is_contradicted and update.state is TrackingState.TRACKING:
            return replace(update, state=TrackingState.DEGRADED)
        return update
