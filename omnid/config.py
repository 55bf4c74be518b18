"""The configuration: all sections on one page. `omnid config` prints it as TOML, --config FILE reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from typing import Annotated, Final, Literal

from msgspec import Meta

from drivers.cameras.v4l2_device import V4l2Settings
from drivers.logs.log_reader import TimeSource
from drivers.logs.mcap_writer import RotationSettings
from omnid.controller.motor import MotorSettings
from omnid.core.control.control_law import ControllerSettings
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.motion_sensors import MotionSensorSettings
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.place_map import PlaceLimits
from omnid.core.stereo.matcher import MatchingSettings
from omnid.engine.process import RealtimeSettings
from omnid.errors import OmnidError
from omnid.settings import changed, load
from omnid.transport.session import BusConfig


@dataclass(frozen=True, slots=True)
class CamerasConfig:
    """Devices and settings of the cameras; both have the same settings."""

    rig: Annotated[str, "calibration of the cameras, see `omnid calibrate`"] = "/etc/omnid/rig.toml"
    lower: Annotated[str, "device of the lower camera, by a persistent name, see `omnid cameras`"] = "/dev/omnid/lower"
    upper: Annotated[str, "device of the upper camera"] = "/dev/omnid/upper"
    width_px: Annotated[int, Meta(ge=16, le=16384), "width of the images, px"] = 1280
    height_px: Annotated[int, Meta(ge=16, le=16384), "height of the images, px"] = 960
    rate_hz: Annotated[float, Meta(ge=0, le=1000), "images per second; 0: the camera's own rate"] = 30.0
    pixel_format: Annotated[
        Literal["auto", "GREY", "NV12", "YUYV", "UYVY", "MJPG", "JPEG"], "pixel format of the images on USB"
    ] = "auto"
    bits: Annotated[
        Literal[8, 10, 12, 16],
        "bits of the camera in the samples of logs that have 16: a camera of 10 bits may fill 10 of them, or all",
    ] = 16
    auto_exposure: Annotated[
        Literal["keep", "on", "off", "rig"],
        "automatic exposure; 'rig': omnid run sets the same exposure and gain for both cameras, "
        "by what the mirrors show without the black corners; where they cannot be set, "
        "and in other commands, as 'on'; 'on': each camera's own; 'keep': as it is",
    ] = "rig"
    exposure_limit_ms: Annotated[
        float,
        Meta(ge=0.1, le=1000),
        "longest exposure of 'rig', ms, and at most 90 % of the images' period; "
        "1 ms blurs by 0.16 px in a turn of 45 deg/s (panorama of 1300 columns)",
    ] = 20.0
    exposure_us: Annotated[int, Meta(ge=0, le=10_000_000), "fixed exposure, us; 0: not fixed"] = 0
    gain: Annotated[
        int, Meta(ge=-1, le=2**31 - 1), "fixed gain in the camera's units, automatic off; -1: not fixed"
    ] = -1
    power_line: Annotated[
        Literal["keep", "off", "50", "60", "auto"], "mains frequency against the flicker of lamps, Hz"
    ] = "keep"
    controls: Annotated[
        tuple[str, ...],
        "other controls by their names in v4l2-ctl --list-ctrls; best with a fixed focus, as each one has another "
        "calibration: 'focus_automatic_continuous=0', 'focus_absolute=20'",
    ] = ()

    def settings(self, camera: str) -> V4l2Settings:
        """Return the settings of the lower or the upper camera; DriverError if they contradict each other."""
        shared = {entry.name: getattr(self, entry.name) for entry in fields(V4l2Settings) if hasattr(self, entry.name)}
        return V4l2Settings(device=self.lower if camera == "lower" else self.upper, **shared)


@dataclass(frozen=True, slots=True)
class PairConfig:
    """Synchronisation of the cameras."""

    tolerance_ms: Annotated[
        float,
        Meta(ge=0, le=1000),
        "largest difference between the stamps of a pair, ms; 0: half the period of the "
        "images, so that cameras may run freely",
    ] = 0.0
    repeated_images: Annotated[
        Literal["drop", "use"],
        "images with all pixels as before, which a frozen camera delivers; 'use' only for simulators without noise",
    ] = "drop"


@dataclass(frozen=True, slots=True)
class LogConfig:
    """Reading of logs."""

    time: Annotated[
        TimeSource,
        "time of capture of an image: 'header': the stamp of its message, 'log': the time of logging, 'auto': the "
        "header's, or the log's where one of those is not set",
    ] = "auto"


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """Reports of `omnid run`."""

    status_s: Annotated[float, Meta(ge=0.1, le=60), "period of the status, s"] = 1.0
    cloud_s: Annotated[float, Meta(ge=0, le=3600), "period of the maps on the bus, s; 0: only at the end"] = 2.0


@dataclass(frozen=True, slots=True)
class RigConfig:
    """Checks of the images against the rig."""

    check: Annotated[
        Literal["refuse", "warn", "off"],
        "if the first images contradict the rig: end with an error, warn only, or do not check",
    ] = "refuse"
    check_s: float = 5.0  # time between two views that a live run compares with the rig


@dataclass(frozen=True, slots=True)
class PanoramaConfig:
    """Size and borders of the panoramas."""

    width_px: Annotated[int, Meta(ge=0, le=65536), "columns of a full turn, px; 0: the images' own resolution"] = 0
    scale: Annotated[float, Meta(ge=0.25, le=1), "columns as a share of the images' own resolution"] = 1.0
    elevation_deg: Annotated[
        tuple[Annotated[float, Meta(ge=-80, le=80)], Annotated[float, Meta(ge=-80, le=80)]],
        "lowest and highest elevation, deg",
    ] = (-50.0, 40.0)
    pad_px: int = 48  # columns more on either side, so that windows run across the seam
    rim_margin_px: float = 4.0  # margin along rim and hub in the images, px
    margin_px: int = 7  # margin along the border of the common view of both cameras, px


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Depth by matching along the columns of the panoramas."""

    min_range_m: Annotated[float, Meta(ge=0.01, le=100), "distance of the nearest points from the rig's axis, m"] = 0.65
    noise_px: float = 0.5  # sigma of a disparity, px: sets the weight of a point in the map
    matching: MatchingSettings = field(default_factory=MatchingSettings)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Visual odometry."""

    method: Annotated[Literal["default", "paper"], "method of the odometry"] = "default"
    tracker: Annotated[Literal["improved", "klt"], "feature tracker of the paper's method"] = "improved"
    noise_px: float = 0.1  # sigma of a tracked corner, px
    klt: KltSettings = field(default_factory=KltSettings)
    limits: OdometryLimits = field(default_factory=OdometryLimits)


@dataclass(frozen=True, slots=True)
class PlacesConfig:
    """Recognition of places: loops, and the pose in the map."""

    enabled: Annotated[bool, "recognise places and correct the pose in the map; off: it is that of odometry"] = True
    map: Annotated[
        str,
        "map of places (.omap) to localise in; a run that recognises it extends it, and makes it where there is none",
    ] = ""
    localize_only: Annotated[bool, "leave the map as it is: do not extend the file, do not move its keyframes"] = False
    save_s: Annotated[
        float, Meta(ge=1, le=86400), "time between two saves of the extended map, s; it is also saved at the end"
    ] = 60.0
    limits: PlaceLimits = field(default_factory=PlaceLimits)


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Voxel map of the whole run."""

    rate_hz: Annotated[
        float,
        Meta(ge=0, le=1000),
        "pairs a second that enter the map, each with dense stereo; 0: all; of a live run only keyframes",
    ] = 5.0
    voxel_m: Annotated[float, Meta(ge=0.001, le=10), "edge of a voxel, m"] = 0.05
    max_voxels: int = 180_000  # largest number of voxels, of 52 bytes each
    max_sigma_m: float = 0.15  # largest sigma of a point that enters the map, m
    min_frames: int = 6  # frames that must have observed a voxel that is written; fewer in a short run
    path_poses: int = 10_000  # vertices of the path in the plan view; when full, every second one is dropped


@dataclass(frozen=True, slots=True)
class ObstaclesConfig:
    """Scan of the nearest obstacles around the base, published as `scan`."""

    enabled: Annotated[bool, "find obstacles; off: nothing keeps the base from driving against them"] = True
    rate_hz: Annotated[float, Meta(ge=0, le=100), "scans a second at most; 0: one for each pair"] = 10.0
    scan: ScanSettings = field(default_factory=ScanSettings)


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """Recordings of `omnid run`, `omnid record` and `omnid replay --record`."""

    enabled: Annotated[bool, "omnid run records images and results"] = False
    images_hz: Annotated[
        float,
        Meta(ge=0, le=1000),
        "pairs of images a second that omnid run records; 0: all, as omnid record does; 5: two hours in 20 GB",
    ] = 5.0
    folder: Annotated[str, "folder of the recordings; it is made if it is missing"] = "recordings"
    file_mb: int = 500  # size at which a new file begins, MB
    keep_mb: Annotated[int, Meta(ge=2, le=1_000_000_000), "total size of all files, MB; the oldest are deleted"] = (
        20_000
    )
    free_mb: Annotated[
        int, Meta(ge=0, le=1_000_000), "free space left on the disk, MB; with less nothing is recorded"
    ] = 1000

    def rotation(self) -> RotationSettings:
        """Return these settings in the units of the driver."""
        return RotationSettings(
            file_bytes=self.file_mb * 10**6, keep_bytes=self.keep_mb * 10**6, free_bytes=self.free_mb * 10**6
        )


@dataclass(frozen=True, slots=True)
class ServiceConfig:
    """Supervision by systemd."""

    stall_timeout_s: Annotated[
        float, Meta(ge=0.5, le=600), "systemd restarts the daemon if a stage works on one message for longer, s"
    ] = 10.0


@dataclass(frozen=True, slots=True)
class Config:
    """The whole configuration."""

    log: LogConfig = field(default_factory=LogConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    pair: PairConfig = field(default_factory=PairConfig)
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


# Keys and sections that only one of `omnid run` and `omnid replay` uses.
_RUN_ONLY: Final = (
    *("bus.panorama_hz.", "cameras.", "controller.", "live.", "motor.", "navigation.", "places.save_s.", "realtime."),
    *("record.", "service."),
)
_REPLAY_ONLY: Final = ("log.",)


def unused_settings(config: Config, command: str, overrides: Sequence[str]) -> list[str]:
    """Return the warning, if there is one, that a command ignores settings of the configuration file.

    command: run or replay. Raises OmnidError for an override that the command ignores.
    """
    others = _REPLAY_ONLY if command == "run" else _RUN_ONLY
    for override in overrides:
        path = ".".join(part.strip() for part in override.partition("=")[0].split("."))
        if f"{path}.".startswith(others):
            raise OmnidError(f"override {override!r}: `omnid {command}` does not use {path}: leave it out")
    ignored = [path for path in changed(config) if f"{path}.".startswith(others)]
    return [f"`omnid {command}` does not use these settings: {', '.join(ignored)}"] if ignored else []


# The settings that a new robot may need, in `omnid config --minimal`.
FIRST_SETTINGS: Final = (
    *(f"cameras.{key}" for key in ("rig", "lower", "upper", "width_px", "height_px", "rate_hz", "auto_exposure")),
    "panorama.scale",
    "places.map",
    *(f"controller.deadlines.{key}" for key in ("pose_s", "command_s")),
    *(f"controller.limits.{key}" for key in ("velocity_mps", "acceleration_mps2", "deceleration_mps2")),
    "controller.limits.yaw_rate_radps",
    "controller.arming",
    *(f"controller.collision.{key}" for key in ("front_m", "rear_m", "half_width_m", "stop_m", "unknown")),
    *(f"navigation.{key}" for key in ("goal_cm", "goal_deg", "clearance_m", "routes", "pursuit.velocity_mps")),
    *(f"motor.{key}" for key in ("port", "protocol", "baud", "watchdog_ms")),
    *(f"motor.drive.{key}" for key in ("track_m", "wheel_radius_m", "max_wheel_mps", "gear")),
    *(f"bus.{key}" for key in ("robot", "listen", "connect", "config", "ros2")),
    *(f"record.{key}" for key in ("enabled", "images_hz", "folder", "keep_mb", "free_mb")),
)
