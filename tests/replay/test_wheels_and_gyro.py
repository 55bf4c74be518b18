"""Logs with wheels and gyro beside the images: darkness is bridged, samples are recorded, wrong topics are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.rig_file import read_rig
from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader, MotionTopics
from drivers.logs.ros_messages import IMU, ODOMETRY
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.config import load_config
from omnid.formats.tum import read_tum
from omnid.runs.replay import ReplayOptions, RunResult, run_log
from omnid.tracking_state import TrackingState
from omnid.transport.sensor_codec import gyro_cdr, wheel_cdr
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, UPPER, Entry, compressed, write_log
from tests.replay.command import recorded
from tests.replay.edited import dark, images
from tests.simulation.logs import SensorErrors, motion_samples

DARK = range(12, 18)
ERRORS = SensorErrors(distance=1.02, turn=0.97, wheel_offset_s=0.01, bias_radps=(0.0, 0.0, 0.01))
WHEELS, GYRO = "/base/wheel_odometry", "/imu/data"


def entry(sample: MotionSample) -> Entry:
    if isinstance(sample, WheelSample):
        return Entry(WHEELS, ODOMETRY, wheel_cdr(sample, sample.stamp_ns), sample.stamp_ns)
    return Entry(GYRO, IMU, gyro_cdr(sample, sample.stamp_ns), sample.stamp_ns)


@pytest.fixture(scope="module")
def samples(scene: Path) -> list[MotionSample]:
    truth = read_tum(scene / "truth.txt")
    return motion_samples(truth.stamps_ns, truth.T, ERRORS, seed=1)


@pytest.fixture(scope="module")
def log(scene: Path, samples: list[MotionSample], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive of `scene`, dark in the middle, with wheels and gyro."""
    folder = tmp_path_factory.mktemp("wheels")
    return saved(folder / "log.mcap", scene, [entry(sample) for sample in samples])


def run(log: Path, scene: Path, *overrides: str, inline: bool = False, record: Path | None = None) -> RunResult:
    options = ReplayOptions(rig=read_rig(scene / "rig.toml"), collect=True, inline=inline, record=record)
    return run_log(log, load_config(None, list(overrides)), options)


def offsets_m(result: RunResult, scene: Path) -> NDArray[np.float64]:
    """Return the distances of the poses from the true ones."""
    truth = read_tum(scene / "truth.txt").T
    true = (se3.inverse(truth[0]) @ truth)[:, :3, 3]
    return np.asarray(np.linalg.norm(result.T_odom_rig[:, :3, 3] - true, axis=1))


def saved(path: Path, scene: Path, more: Sequence[Entry]) -> Path:
    topics = {"lower": LOWER, "upper": UPPER}
    taken = [dark(image) if image.pair in DARK else image for image in images(scene / "log.mcap")]
    entries = [Entry(topics[p.camera], COMPRESSED, compressed(p.stamp_ns, p.jpeg), p.written_ns) for p in taken]
    return write_log(path, sorted([*entries, *more], key=lambda each: each.log_time_ns))


def test_darkness_is_bridged_and_the_bytes_are_the_same_threaded_and_inline(
    log: Path, scene: Path, tmp_path: Path
) -> None:
    record = tmp_path / "out.mcap"
    result = run(log, scene, inline=True, record=record)
    assert result.states.count(TrackingState.LOST) == 0
    assert [state for state in result.states if state == TrackingState.DEGRADED]
    assert offsets_m(result, scene).max() < 0.02 and result.counters.resets == 0
    threaded = run(log, scene)
    assert np.array(threaded.T_odom_rig).tobytes() == np.array(result.T_odom_rig).tobytes()
    without = run(log, scene, "motion.wheels=off", "motion.imu=off")
    assert without.states.count(TrackingState.LOST) > 0
    assert len(recorded(record, "/omnid/wheel_odom")) > 80 and len(recorded(record, "/omnid/imu")) > 160


def test_broken_messages_and_topics_that_are_not_clear_are_reported(
    scene: Path, samples: list[MotionSample], tmp_path: Path
) -> None:
    sample = samples[0]
    wrong = [
        entry(sample)._replace(data=entry(sample).data[:40]),
        Entry(GYRO, IMU, b"", sample.stamp_ns),
        entry(next(each for each in samples if isinstance(each, GyroSample)))._replace(topic="/imu/other"),
    ]
    log = saved(tmp_path / "log.mcap", scene, wrong)
    reader = LogReader(log, motion=MotionTopics(imu=GYRO))
    assert len(list(reader.messages())) == 2 * PAIRS and reader.counts["broken_motion"] == 2
    assert "skipped 2 messages of wheels or IMU" in reader.warnings[0]
    reader = LogReader(log, motion=MotionTopics())
    list(reader.messages())
    assert "several topics of sensor_msgs/msg/Imu" in reader.warnings[0] and "motion.imu" in reader.warnings[0]
    with pytest.raises(DriverError, match=r"'/nothing' is no topic of nav_msgs.*motion\.wheels must be one"):
        LogReader(log, motion=MotionTopics(wheels="/nothing"))


@pytest.mark.parametrize("shift_s", [3600, -3600])
def test_sensors_with_another_clock_than_the_images_are_named(
    scene: Path, samples: list[MotionSample], tmp_path: Path, shift_s: int
) -> None:
    def shifted(sample: MotionSample) -> Entry:
        if isinstance(sample, WheelSample):
            return entry(sample)
        late = replace(sample, stamp_ns=sample.stamp_ns + shift_s * 10**9)
        return entry(sample)._replace(data=entry(late).data)

    log = saved(tmp_path / "log.mcap", scene, [*map(shifted, samples)])
    reader = LogReader(log, motion=MotionTopics())
    assert len(list(reader.frames())) == 2 * PAIRS
    (line,) = reader.warnings
    assert f"no sample of {GYRO} is used" in line and "another clock" in line
    part = LogReader(log, span_s=(0.0, 0.001), motion=MotionTopics())
    assert len(list(part.frames())) == 2 and part.warnings == [], "so short a part holds no samples anyway"


def test_a_pose_that_the_wheels_contradict_is_degraded_and_its_sigma_covers_theirs(
    scene: Path, samples: list[MotionSample], tmp_path: Path
) -> None:
    """As if the rig were smaller than it says. In the dark, wheels whose scale was learned carry the pose."""
    faster = [
        replace(sample, velocity_mps=1.7 * sample.velocity_mps) if isinstance(sample, WheelSample) else sample
        for sample in samples
    ]
    honest, contradicted = (
        run(saved(tmp_path / f"{name}.mcap", scene, [entry(sample) for sample in log]), scene)
        for name, log in (("honest", samples), ("faster", faster))
    )
    assert any("images and wheels disagree" in line for line in contradicted.warnings)
    assert not any("images and wheels disagree" in line for line in honest.warnings)
    assert contradicted.states[-1] == TrackingState.DEGRADED and honest.states[-1] == TrackingState.TRACKING
    sigma_m, honest_m = (np.sqrt(np.diag(result.covariances[-1])[:3].max()) for result in (contradicted, honest))
    travelled_m = float(np.linalg.norm(contradicted.T_odom_rig[-1, :3, 3]))
    assert 0.3 * 0.7 * travelled_m < sigma_m < 0.7 * travelled_m and honest_m < 0.02
