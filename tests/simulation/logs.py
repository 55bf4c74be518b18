"""Rendered logs with their truth: images in whole grey levels, samples of wheels and gyro, MCAP."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from calib import se3
from calib.models.camera import Array
from calib.rig import MountedCamera, Rig
from calib.rig_file import write_rig
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.simulation.rendering.ray_caster import Floats, Sensor
from omnid.simulation.rendering.surfaces import Scene
from tests.simulation.disturbances import Disturbance, DisturbedCamera, MountedSensor, jpeg
from tests.simulation.rigs import MirrorCamera, nominal_rig, render_real


def render(scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 of the camera on a rig at T_world_rig; 0 outside the mask."""
    return np.clip(np.rint(render_real(scene, mounted, T_world_rig, supersample)), 0, 255).astype(np.uint8)


PERIOD_NS = 100_000_000
# Two steps whose rotations differ by more are not averaged: the smaller one is the motion during the exposures.
MAX_CHANGE_RAD = np.deg2rad(10.0)


@dataclass(frozen=True, slots=True)
class Readout:
    """Times of the exposures of a log; the default is a global shutter and simultaneous exposures.

    skew_ms: of the first and of the last pair, linear between. line_time_us: from one image row to the next, lower and
    upper camera.
    """

    speed: float = 1.0  # factor on the speed of the run: the pairs follow faster, the poses stay
    skew_ms: tuple[float, float] = (0.0, 0.0)
    line_time_us: tuple[float, float] = (0.0, 0.0)

    @property
    def period_ns(self) -> int:
        """Return the time from one pair to the next."""
        return round(PERIOD_NS / self.speed)

    @property
    def is_synchronous(self) -> bool:
        """True if both images show the same instant."""
        return not (any(self.skew_ms) or any(self.line_time_us))

    def skew_ns(self, pairs: int) -> Array:
        """Return upper minus lower stamp (N,) [ns] of every pair."""
        return np.rint(1e6 * np.linspace(*self.skew_ms, pairs))

    def delay_s(self, pairs: int) -> Array:
        """Return the time (N,) [s] from the lower to the upper exposure of every pair."""
        return 1e-9 * self.skew_ns(pairs)


def body_twists(poses: Array, period_s: float) -> Array:
    """Return the twists (N, 6) per second of the rig at poses T_world_rig (N, 4, 4), in its own frame.

    Mean of the step before and the step after; of a sudden turn only the smaller step counts, so that it takes place
    between the exposures.
    """
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / period_s
    before, after = np.concatenate([steps[:1], steps]), np.concatenate([steps, steps[-1:]])
    sudden = np.linalg.norm(before[:, 3:] - after[:, 3:], axis=1) * period_s > MAX_CHANGE_RAD
    smaller = np.linalg.norm(before[:, 3:], axis=1) < np.linalg.norm(after[:, 3:], axis=1)
    one = np.where(smaller[:, None], before, after)
    return np.where(sudden[:, None], one, (before + after) / 2)


START_NS = 1_700_000_000_000_000_000
# Delay from an image's stamp to its arrival at the recorder.
ARRIVAL_NS = 3_000_000
# Largest difference of the two cameras' stamps where the exposures are simultaneous.
SKEW_NS = 2_000_000
SCHEMA = "sensor_msgs/msg/CompressedImage"
# [ns]
Stamps = NDArray[np.int64]
# Number of the pair, JPEG of lower and upper camera.
Images = Iterator[tuple[int, bytes, bytes]]


def write_log(
    folder: Path,
    rig: Rig,
    poses: Array,
    scene: Scene,
    *,
    sensor: Sensor | None = None,
    seed: int = 0,
    supersample: int = 2,
    readout: Readout | None = None,
    disturbances: Collection[Disturbance] = (),
) -> None:
    """Render both cameras' images at poses T_world_rig (N, 4, 4), and write the log and its ground truth to folder.

    rig.toml has masks of the rims only. A rig of ray-traced mirrors has no model: nominal.toml is what its builder
    knows. Without a readout both images of a pair show the instant of the lower camera's stamp, and stamps differ by up
    to SKEW_NS. Same arguments, same bytes.
    """
    readout = readout or Readout()
    cameras, delay_s = (rig.lower, rig.upper), readout.delay_s(len(poses))
    twists = body_twists(poses, 1e-9 * readout.period_ns)
    disturbed = [
        DisturbedCamera.of(disturbances, number, mounted.visible, mounted.camera.size, seed)
        for number, mounted in enumerate(cameras)
    ]

    def ideal_image(pair: int, camera: int) -> Floats:
        row_twist = twists[pair] * 1e-6 * readout.line_time_us[camera]
        delays_s = [delay_s[pair] * camera + at_s for at_s in disturbed[camera].times_s()]
        parts = []
        for late_s in delays_s:
            T_world_rig = poses[pair] @ se3.exp(twists[pair] * late_s)
            parts.append(render_real(scene, cameras[camera], T_world_rig, supersample, row_twist))
        time_s = 1e-9 * readout.period_ns * pair + delay_s[pair] * camera
        return disturbed[camera].shown(np.mean(parts, axis=0, dtype=np.float32), time_s)

    folder.mkdir(parents=True, exist_ok=True)
    stamps: Stamps = START_NS + readout.period_ns * np.arange(len(poses), dtype=np.int64)
    (folder / "truth.txt").write_text(tum(stamps, poses))
    rng = np.random.default_rng([seed, 6])
    skews: Stamps = rng.integers(-SKEW_NS, SKEW_NS + 1, len(poses), dtype=np.int64)
    if not readout.is_synchronous:
        skews = readout.skew_ns(len(poses)).astype(np.int64)
    sensor = sensor or Sensor()
    exposures = [MountedSensor(sensor, m.visible, m.camera.size) for m in (rig.lower, rig.upper)]
    if isinstance(rig.lower.camera, MirrorCamera):
        write_rig(folder / "nominal.toml", nominal_rig(rig))
    else:
        write_rig(folder / "rig.toml", rig)

    def encoded(pair: int, camera: int) -> bytes:
        exposed = exposures[camera].expose(ideal_image(pair, camera), rng)
        image = disturbed[camera].digitised(exposed)
        return disturbed[camera].encoded(image, pair) or jpeg(image)

    images = ((i, encoded(i, 0), encoded(i, 1)) for i in range(len(poses)))
    # log.mcap appears only when it is complete.
    _write_mcap(folder / "log.mcap.part", rig, (stamps, stamps + skews), images)
    (folder / "log.mcap.part").replace(folder / "log.mcap")


def _write_mcap(path: Path, rig: Rig, stamps: tuple[Stamps, Stamps], images: Images) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    Image, Header = store.types[SCHEMA], store.types["std_msgs/msg/Header"]
    Time = store.types["builtin_interfaces/msg/Time"]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="")
        definition, _ = store.generate_msgdef(SCHEMA, ros_version=2)
        schema = writer.register_schema(SCHEMA, "ros2msg", definition.encode())
        channels = [writer.register_channel(topic, "cdr", schema) for topic in rig.topics]
        for i, *jpegs in images:
            pair = [(int(stamps[k][i]), k) for k in (0, 1)]
            for stamp, k in sorted(pair):
                header = Header(Time(*divmod(stamp, 10**9)), ("lower", "upper")[k])
                message = Image(header, "jpeg", np.frombuffer(jpegs[k], np.uint8))
                data = bytes(store.serialize_cdr(message, SCHEMA))
                writer.add_message(channels[k], stamp + ARRIVAL_NS, data, stamp, 2 * i + k)
        writer.finish()  # type: ignore[no-untyped-call]


def tum(stamps_ns: Stamps, poses: Array) -> str:
    """Return the trajectory as TUM text: t x y z qx qy qz qw."""
    rows = []
    for stamp, T in zip(stamps_ns, poses, strict=True):
        values = " ".join(f"{x:.9f}" for x in (*T[:3, 3], *se3.quaternion(T[:3, :3])))
        rows.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {values}\n")
    return "".join(rows)


@dataclass(frozen=True)
class SensorErrors:
    """Errors of wheels and gyro; the noise is that of encoders and of a common MEMS gyro."""

    distance: float = 1.0  # metres of the base per metre of the wheels
    turn: float = 1.0
    wheel_offset_s: float = 0.0  # to be added to the stamps
    gyro_offset_s: float = 0.0
    bias_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wheel_sigma: tuple[float, float] = (0.002, 0.004)  # m/s, rad/s of a sample
    gyro_sigma_radps: float = 0.003
    wheel_period_s: float = 0.02
    gyro_period_s: float = 0.01


def motion_samples(
    stamps_ns: NDArray[np.int64], T_odom_base: Array, errors: SensorErrors, seed: int
) -> list[MotionSample]:
    """Return the samples, in the order of their stamps, of a base with poses (N, 4, 4); between them it is steady."""
    rng, times_s = np.random.default_rng(seed), (stamps_ns - stamps_ns[0]) * 1e-9
    twists = se3.log(se3.inverse(T_odom_base[:-1]) @ T_odom_base[1:]) / np.diff(times_s)[:, None]

    def at(period_s: float, offset_s: float) -> Iterator[tuple[int, Array]]:
        for time_s in np.arange(0.0, times_s[-1] + 0.2, period_s):
            step = min(int(np.searchsorted(times_s, time_s, side="right")) - 1, len(twists) - 1)
            yield int(stamps_ns[0]) + round((time_s - offset_s) * 1e9), twists[step]

    found: list[MotionSample] = []
    for stamp_ns, rates in at(errors.wheel_period_s, errors.wheel_offset_s):
        found.append(
            WheelSample(
                stamp_ns,
                rates[0] / errors.distance + rng.normal(0, errors.wheel_sigma[0]),
                rates[5] / errors.turn + rng.normal(0, errors.wheel_sigma[1]),
            )
        )
    for stamp_ns, rates in at(errors.gyro_period_s, errors.gyro_offset_s):
        turn = rates[3:] + errors.bias_radps + rng.normal(0, errors.gyro_sigma_radps, 3)
        found.append(GyroSample(stamp_ns, *turn.tolist(), of_base=True))
    return sorted(found, key=lambda sample: sample.stamp_ns)
