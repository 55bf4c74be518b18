"""The configuration: all sections on one page. `omnid config` prints it as TOML, --config FILE reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Final

from drivers.logs.log_folder import RotationSettings
from omnid.camera_config import CamerasConfig, PairConfig, TimingConfig
from omnid.controller.motor_settings import MotorSettings
from omnid.core.control.control_law import ControllerSettings
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.obstacles.settings import RingSettings
from omnid.core.odometry.limits import OdometryLimits
from omnid.core.odometry.motion_settings import MotionSensorSettings
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.limits import PlaceLimits
from omnid.core.stereo.matcher import MatchingSettings
from omnid.engine.realtime import RealtimeSettings
from omnid.settings import knob, load
from omnid.transport.bus_config import BusConfig


@dataclass(frozen=True, slots=True)
class LogConfig:
    """Reading of logs."""

    reorder_frames: int = knob(32, "images sorted by their stamps: how late one may be in the log", low=1, high=1000)


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """Reports of `omnid run`."""

    status_s: float = knob(1.0, "period of the status, s", low=0.1, high=60)
    cloud_s: float = knob(2.0, "period of the maps on the bus, s; 0: only at the end", low=0, high=3600)
    cloud_points: int = knob(
        50_000, "largest number of map points on the bus: the most confident ones", low=0, high=10_000_000
    )
    shed_load: bool = knob(True, "give up the map, then half the landmarks, while the computer is too slow")


@dataclass(frozen=True, slots=True)
class RigConfig:
    """Is the rig right? Checks of the images against it."""

    check: str = knob(
        "refuse",
        "if the first images contradict the rig: end with an error, warn only, or do not check",
        choices=("refuse", "warn", "off"),
    )
    check_s: float = knob(
        5.0, "time between two views that a live run compares with the rig, s; 0: none", low=0, high=3600
    )


@dataclass(frozen=True, slots=True)
class PanoramaConfig:
    """Size and borders of the panoramas."""

    width_px: int = knob(0, "columns of a full turn, px; 0: the images' own resolution", low=0, high=65536)
    scale: float = knob(1.0, "where width_px is 0: columns as a share of the images' own resolution", low=0.25, high=1)
    elevation_deg: tuple[float, float] = knob((-50.0, 40.0), "lowest and highest elevation, deg", low=-80, high=80)
    pad_px: int = knob(48, "columns more on either side, so that windows run across the seam", low=16, high=256)
    rim_margin_px: float = knob(4.0, "margin along rim and hub in the images, px", low=0, high=100)
    margin_px: int = knob(7, "margin along the border of the common view of both cameras, px", low=0, high=100)


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Depth by matching along the columns of the panoramas."""

    min_range_m: float = knob(0.65, "distance of the nearest points from the rig's axis, m", low=0.01, high=100)
    noise_px: float = knob(0.5, "sigma of a disparity, px: sets the weight of a point in the map", low=0.01, high=10)
    matching: MatchingSettings = field(default_factory=MatchingSettings)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Visual odometry."""

    method: str = knob("default", "method of the odometry", choices=("default", "paper"))
    tracker: str = knob("improved", "feature tracker of the paper's method", choices=("improved", "klt"))
    reference: str = knob("previous", "reference frame of the paper's method", choices=("previous", "keyframe"))
    noise_px: float = knob(0.1, "sigma of a tracked corner, px", low=0.01, high=10)
    klt: KltSettings = field(default_factory=KltSettings)
    limits: OdometryLimits = field(default_factory=OdometryLimits)


@dataclass(frozen=True, slots=True)
class PlacesConfig:
    """Recognition of places: loops, and the pose in the map."""

    enabled: bool = knob(True, "recognise places and correct the pose in the map; off: it is that of odometry")
    map: str = knob(
        "",
        "map of places (.omap) to localise in; a run that recognises it extends it, and makes it where there is none",
    )
    localize_only: bool = knob(False, "leave the map as it is: do not extend the file, do not move its keyframes")
    save_s: float = knob(
        60.0, "time between two saves of the extended map, s; it is also saved at the end", low=1, high=86400
    )
    limits: PlaceLimits = field(default_factory=PlaceLimits)


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Voxel map of the whole run."""

    rate_hz: float = knob(
        5.0,
        "pairs a second that enter the map, each with dense stereo; 0: all; "
        "keyframes only while no client receives and no log records the cloud of a live run",
        low=0,
        high=1000,
    )
    voxel_m: float = knob(0.05, "edge of a voxel, m", low=0.001, high=10)
    log2_voxels: int = knob(18, "the map holds up to 0.7 * 2^n voxels of 52 bytes", low=10, high=24)
    max_sigma_m: float = knob(0.15, "largest sigma of a point that enters the map, m", low=0.001, high=100)
    min_frames: int = knob(
        6, "frames that must have observed a voxel that is written; fewer in a short run", low=1, high=1000
    )
    path_poses: int = knob(
        10_000,
        "vertices of the path in the plan view; when full, every second one is dropped",
        low=100,
        high=10_000_000,
    )


@dataclass(frozen=True, slots=True)
class ObstaclesConfig:
    """Ring of the nearest obstacles around the base, published as scan."""

    enabled: bool = knob(True, "find obstacles; off: nothing keeps the base from driving against them")
    rate_hz: float = knob(10.0, "rings a second at most; 0: one for each pair", low=0, high=100)
    ring: RingSettings = field(default_factory=RingSettings)


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """Recordings of `omnid run`, `omnid record` and `omnid replay --record`."""

    enabled: bool = knob(False, "omnid run records images and results")
    folder: str = knob("recordings", "folder of the recordings; it is made if it is missing")
    file_mb: int = knob(500, "size at which a new file begins, MB", low=1, high=1_000_000)
    file_s: float = knob(600.0, "duration at which a new file begins, s", low=1, high=86_400)
    keep_files: int = knob(1000, "number of files kept; the oldest are deleted", low=1, high=100_000)
    keep_mb: int = knob(20_000, "total size of all files, MB; the oldest are deleted", low=2, high=1_000_000_000)
    free_mb: int = knob(1000, "free space left on the disk, MB; with less nothing is recorded", low=0, high=1_000_000)
    sync_s: float = knob(
        3.0, "period of syncing the files to the disk, s: a power cut loses no more", low=0.1, high=3600
    )
    queue: int = knob(20, "messages of each kind that may wait for the disk; more drop the oldest", low=1, high=1000)
    cloud_points: int = knob(
        200_000, "largest number of map points in the log: the most confident ones", low=0, high=10_000_000
    )

    def rotation(self) -> RotationSettings:
        """Return these settings in the units of the driver."""
        return RotationSettings(
            self.file_mb * 10**6, self.file_s, self.keep_files, self.keep_mb * 10**6, self.free_mb * 10**6, self.sync_s
        )


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """Inboxes and threads of the stages."""

    depth: int = knob(2, "messages that may wait in front of a stage", low=1, high=100)
    opencv_threads: int = knob(1, "threads OpenCV may use within a stage", low=1, high=64)


@dataclass(frozen=True, slots=True)
class ServiceConfig:
    """Supervision by systemd."""

    stall_timeout_s: float = knob(
        10.0, "systemd restarts the daemon if a stage works on one message for longer, s", low=0.5, high=600
    )


@dataclass(frozen=True, slots=True)
class Config:
    """The whole configuration."""

    log: LogConfig = field(default_factory=LogConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    pair: PairConfig = field(default_factory=PairConfig)
    camera: TimingConfig = field(default_factory=TimingConfig)
    motion: MotionSensorSettings = field(default_factory=MotionSensorSettings)
    panorama: PanoramaConfig = field(default_factory=PanoramaConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    places: PlacesConfig = field(default_factory=PlacesConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    obstacles: ObstaclesConfig = field(default_factory=ObstaclesConfig)
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    navigation: NavigationSettings = field(default_factory=NavigationSettings)
    motor: MotorSettings = field(default_factory=MotorSettings)
    live: LiveConfig = field(default_factory=LiveConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    realtime: RealtimeSettings = field(default_factory=RealtimeSettings)
    service: ServiceConfig = field(default_factory=ServiceConfig)

    def stereo_settings(self) -> StereoConfig:
        """Return the stereo settings that go with the odometry's method.

        The paper's odometry works on the enhanced SAD (Dang et al. 2012, III.B). Any stereo.matching.method other than
        "auto" wins, with either odometry.
        """
        matching = self.stereo.matching
        if self.odometry.method == "paper" and matching.method == "auto":
            return replace(self.stereo, matching=replace(matching, method="enhanced"))
        return self.stereo


def load_config(path: str | PathLike[str] | None = None, overrides: Sequence[str] = ()) -> Config:
    """Return the configuration of a TOML file, or the defaults, changed by overrides such as "motor.rate_hz=50".

    Raises OmnidError.
    """
    return load(Config, path, overrides)


# The settings that a new robot needs, in `omnid config --minimal`.
FIRST_SETTINGS: Final = (
    "cameras.rig",
    "cameras.lower",
    "cameras.upper",
    "cameras.width_px",
    "cameras.height_px",
    "cameras.rate_hz",
    "controller.limits.velocity_mps",
    "controller.limits.yaw_rate_radps",
    "motor.port",
    "motor.protocol",
    "motor.drive.track_m",
    "bus.robot",
    "bus.listen",
    "record.enabled",
    "record.folder",
)
