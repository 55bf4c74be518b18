"""The public Python API: lazy imports, replay, odometry of images, and the example programs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

import omnid
from calib.rig_file import read_rig, write_rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid.engine.graph import Graph
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, tum_row
from tests.conftest import PAIRS
from tests.ply import read_ply
from tests.replay import edited
from tests.replay.command import Command

pytestmark = pytest.mark.usefixtures("default_signals")

ROOT = Path(__file__).parents[2]
Pair = tuple[int, np.ndarray, np.ndarray]
FEW = 8  # pairs


@pytest.fixture(scope="module")
def pairs(scene: Path) -> list[Pair]:
    """The pairs of the scene: stamp of the lower image, lower and upper image."""
    frames = list(LogReader(scene / "log.mcap").frames())
    lower, upper = ([frame for frame in frames if frame.camera == name] for name in ("lower", "upper"))
    return [(below.stamp_ns, gray(below), gray(above)) for below, above in zip(lower, upper, strict=True)]


@pytest.fixture(scope="module")
def start(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the first pairs of the scene."""
    path = tmp_path_factory.mktemp("start") / "log.mcap"
    return edited.save(path, (image for image in edited.images(scene / "log.mcap") if image.pair < FEW))


@pytest.fixture(scope="module")
def result(scene: Path) -> omnid.RunResult:
    """The result of a replay of the scene."""
    return omnid.replay(scene / "log.mcap", rig=scene / "rig.toml")


@pytest.fixture
def omnid_command(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(capsys)


def test_import_loads_neither_numpy_nor_opencv() -> None:
    program = "import omnid, sys; print(sorted({'numpy', 'cv2', 'zenoh', 'omnid.config'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert out == "[]\n"


def test_every_public_name_is_found_and_no_other() -> None:
    for name in omnid.__all__:
        assert getattr(omnid, name) is not None and name in dir(omnid)
    with pytest.raises(AttributeError, match="no attribute 'play'"):
        omnid.play  # type: ignore[attr-defined]  # noqa: B018
    assert find_spec("omnid.replay") is None, "a submodule of this name would replace the function"


def test_replay_gives_what_the_command_writes(
    omnid_command: Command, tmp_path: Path, scene: Path, result: omnid.RunResult
) -> None:
    files = ("--tum", tmp_path / "a.tum", "--cloud", tmp_path / "a.ply")
    assert omnid_command.replay(scene / "log.mcap", *files, rig=scene / "rig.toml").code == 0
    result.save_tum(tmp_path / "b.tum")
    result.save_ply(str(tmp_path / "b.ply"))
    for suffix in ("tum", "ply"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    assert len(read_ply(tmp_path / "b.ply").xyz) > 500


def test_the_result_holds_arrays_counters_and_timings(result: omnid.RunResult) -> None:
    assert result.stamps_ns.shape == (PAIRS,) and result.stamps_ns.dtype == np.int64
    assert result.T_odom_rig.shape == (PAIRS, 4, 4) and result.covariances.shape == (PAIRS, 6, 6)
    assert set(result.states) == {omnid.TrackingState.TRACKING} and len(result.states) == PAIRS
    counters = result.counters
    assert (counters.pairs, counters.poses, counters.resets) == (PAIRS, PAIRS, 0)
    assert counters.states[omnid.TrackingState.TRACKING] == PAIRS and not any(counters.drops.values())
    steps = np.diff(result.T_odom_rig[:, :3, 3], axis=0)
    assert counters.length_m == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    assert result.signal == 0
    assert len(result.warnings) == 1 and "height of the cameras" in result.warnings[0]  # the rig does not state it
    for stage in ("pair", "dewarp", "odometry", "mapping"):
        timing = result.timings[stage]
        assert timing.n >= PAIRS and 0 < timing.p50_ms <= timing.p99_ms <= timing.max_ms
    assert not {"statistics", "collect-poses"} & result.timings.keys()


def test_a_result_is_compared_with_the_truth(result: omnid.RunResult, tmp_path: Path) -> None:
    result.save_tum(tmp_path / "truth.tum")
    metrics = result.evaluate(tmp_path / "truth.tum")
    assert metrics.pairs == PAIRS and metrics.ate_max_m < 1e-6 and "position error (ATE)" in str(metrics)
    longer = Trajectory(result.stamps_ns, result.T_odom_rig.copy())
    longer.T[:, :3, 3] *= 1.25
    assert result.evaluate(longer).length_error_ratio == pytest.approx(1 / 1.25 - 1)


def test_a_replay_reports_its_progress(scene: Path, start: Path) -> None:
    seen: list[tuple[int, int | None]] = []
    omnid.replay(start, rig=scene / "rig.toml", progress=lambda *counts: seen.append(counts))
    assert seen[-1] == (FEW, FEW) and [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_replay_takes_settings_a_rig_and_a_method(scene: Path, start: Path, result: omnid.RunResult) -> None:
    rig = read_rig(scene / "rig.toml")
    config = replace(omnid.Config(), mapping=replace(omnid.Config().mapping, voxel_m=0.2))
    coarse = omnid.replay(scene / "log.mcap", rig, config=config)
    assert result.map is not None and coarse.map is not None and len(coarse.map.xyz) < len(result.map.xyz) / 2
    assert np.array_equal(coarse.T_odom_rig, result.T_odom_rig)
    paper = omnid.replay(start, rig, config=config, method="paper", overrides="log.rate_hz=8")
    assert len(paper.stamps_ns) == FEW and not np.array_equal(paper.T_odom_rig, result.T_odom_rig[:FEW])


def test_images_give_the_bytes_of_a_replay(scene: Path, pairs: list[Pair], result: omnid.RunResult) -> None:
    odometry = omnid.Odometry(scene / "rig.toml")
    poses = [odometry.process(*pair) for pair in pairs]
    assert np.array_equal([pose.T_odom_rig for pose in poses], result.T_odom_rig)
    assert np.array_equal([pose.covariance for pose in poses], result.covariances)
    rows = [tum_row(pose.stamp_ns, pose.T_odom_rig) for pose in poses]
    assert rows == [tum_row(int(s), T) for s, T in zip(result.stamps_ns, result.T_odom_rig, strict=True)]
    depth, seen = odometry.depth(poses[-1]), poses[-1].depth.panoramas
    assert depth.disparity.shape == seen.lower.panorama.shape == seen.upper.panorama.shape
    assert depth.points.shape == (len(depth.variance_m2), 3) and len(depth.points) > 500


def test_wrong_images_and_stamps_are_refused_and_change_nothing(scene: Path, pairs: list[Pair]) -> None:
    odometry, whole = omnid.Odometry(scene / "rig.toml"), omnid.Odometry(scene / "rig.toml")
    first_ns, lower, upper = pairs[0]
    wrong = {
        "found nothing": (first_ns, None, upper),
        "found list": (first_ns, lower, upper.tolist()),
        r"found \(256, 256, 3\) uint8: convert": (first_ns, cv2.cvtColor(lower, cv2.COLOR_GRAY2BGR), upper),
        r"lower image.*found \(255, 256\)": (first_ns, lower[1:], upper),
        r"upper image.*found \(256, 256\) float64": (first_ns, lower, upper.astype(float)),
        "expected an integer": (first_ns * 1e-9, lower, upper),
    }
    for message, arguments in wrong.items():
        with pytest.raises(OmnidError, match=message):
            odometry.process(*arguments)  # type: ignore[arg-type]
    np.testing.assert_allclose(odometry.process(*pairs[0]).T_odom_rig, np.eye(4), atol=1e-12)
    for stamp_ns in (first_ns, first_ns - 1):
        with pytest.raises(OmnidError, match="expected a stamp after"):
            odometry.process(stamp_ns, lower, upper)
    whole.process(*pairs[0])
    assert np.array_equal(odometry.process(*pairs[1]).T_odom_rig, whole.process(*pairs[1]).T_odom_rig)


def test_an_image_that_repeats_an_earlier_one_is_refused_and_changes_nothing(scene: Path, pairs: list[Pair]) -> None:
    """A replay drops it: of a camera that is frozen the pose would stand still with a sigma of a millimetre."""
    odometry, whole, used = (
        omnid.Odometry(scene / "rig.toml", overrides=[f'pair.repeated_images="{policy}"'])
        for policy in ("drop", "drop", "use")
    )
    buffers = [np.empty_like(image) for image in pairs[0][1:]]  # a program may read all images into the same arrays
    for number, (stamp_ns, *images) in enumerate(pairs[:4]):
        for buffer, image in zip(buffers, images, strict=True):
            buffer[:] = image
        pose, expected = odometry.process(stamp_ns, *buffers), whole.process(stamp_ns, *images)
        assert np.array_equal(pose.T_odom_rig, expected.T_odom_rig)
        used.process(stamp_ns, *images)
        for lower, upper, found in (
            (*images, "lower and the upper camera"),
            (images[0], images[1] ^ np.uint8(number + 1), "the lower camera"),
        ):
            with pytest.raises(OmnidError, match=f"image of the {found.removeprefix('the ')} is an earlier one"):
                odometry.process(stamp_ns + 1, lower, upper)
        used.process(stamp_ns + 1, *images)
    for later_ns in (1, 2):
        for buffer in buffers:
            buffer[1, later_ns] ^= 1
        odometry.process(stamp_ns + later_ns, *buffers)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("absent.mcap", "rig.toml"), "absent.mcap"),
        (("log.mcap", "absent.toml"), "absent.toml"),
        (("log.mcap",), "rig"),
    ],
)
def test_one_error_class_for_all_wrong_input(scene: Path, arguments: tuple[str, ...], named: str) -> None:
    with pytest.raises(OmnidError, match=named):
        omnid.replay(*(scene / name for name in arguments))
    with pytest.raises(OmnidError, match=r"absent\.toml"):
        omnid.Odometry(scene / "absent.toml")
    with pytest.raises(OmnidError, match="sterio"):
        omnid.Odometry(scene / "rig.toml", overrides=["sterio.noise_px=1"])


def test_settings_that_a_replay_ignores_are_warnings_or_errors(tmp_path: Path, scene: Path, start: Path) -> None:
    (tmp_path / "omnid.toml").write_text("[live]\nstatus_s = 2.0\n")
    found = omnid.replay(start, scene / "rig.toml", config=tmp_path / "omnid.toml")
    assert "live.status_s" in found.warnings[0]
    with pytest.raises(OmnidError, match=r"live\.status_s"):
        omnid.replay(start, scene / "rig.toml", overrides=["live.status_s=2.0"])


def test_ctrl_c_ends_a_replay_with_a_keyboard_interrupt(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Graph.run

    def interrupt() -> Iterator[object]:
        os.kill(os.getpid(), signal.SIGINT)
        return iter(())

    def interrupted(self: Graph) -> None:
        self.source("interrupt", interrupt)
        run(self)

    monkeypatch.setattr(Graph, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        omnid.replay(scene / "log.mcap", scene / "rig.toml")


def example(name: str, *words: object, cwd: Path) -> str:
    """The output of an example that is run as a program."""
    command = [sys.executable, "-m", f"omnid.examples.{name}", *map(str, words)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment, check=True).stdout


def test_example_of_a_replay(tmp_path: Path, scene: Path, result: omnid.RunResult) -> None:
    out = example("replay_log", scene / "log.mcap", scene / "rig.toml", cwd=tmp_path)
    assert out.startswith(f"{PAIRS} poses, {result.counters.length_m:.2f} m")
    result.save_tum(tmp_path / "expected.tum")
    assert (tmp_path / "trajectory.tum").read_bytes() == (tmp_path / "expected.tum").read_bytes()
    assert (tmp_path / "map.ply").stat().st_size > 1000


def test_example_of_images(tmp_path: Path, scene: Path, pairs: list[Pair], result: omnid.RunResult) -> None:
    for name, index in (("lower", 1), ("upper", 2)):
        (tmp_path / name).mkdir()
        for pair in pairs[:5]:
            cv2.imwrite(str(tmp_path / name / f"{pair[0]}.png"), pair[index])
    lines = example("images_to_poses", scene / "rig.toml", tmp_path, cwd=tmp_path).splitlines()
    x_m, y_m = result.T_odom_rig[4, :2, 3]
    assert len(lines) == 5 and f"tracking ({x_m:.3f}, {y_m:.3f}) m" in lines[4]


def test_example_of_the_geometry(tmp_path: Path, scene: Path, pairs: list[Pair]) -> None:
    write_rig(tmp_path / "rig.toml", read_rig(scene / "rig.toml"))
    cv2.imwrite(str(tmp_path / "lower.png"), pairs[0][1])
    out = example("rectify_image", "rig.toml", "lower.png", "panorama.png", cwd=tmp_path)
    panorama = cv2.imread(str(tmp_path / "panorama.png"), cv2.IMREAD_GRAYSCALE)
    assert "is at pixel" in out and panorama is not None and panorama.shape[1] > 4 * panorama.shape[0] / 2
    with pytest.raises(subprocess.CalledProcessError) as raised:
        example("rectify_image", cwd=tmp_path)
    assert "`python -m omnid.examples.rectify_image " in raised.value.stderr and "Traceback" not in raised.value.stderr
