"""`omnid calibrate drive`: refusals in one line, and a disturbed rig put right from a drive through a rendered room."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from omnid import replay
from omnid.cli import main
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from tests.replay.edited import images, save
from tests.simulation import build, write_log
from tests.simulation.rigs import with_real_mirrors


@pytest.fixture(scope="module")
def short(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log of the first six pairs of the scene, of which a refusal takes a second."""
    path = tmp_path_factory.mktemp("short") / "log.mcap"
    save(path, (image for image in images(scene / "log.mcap") if image.pair < 6))
    return path


def calibrate(*words: object) -> int:
    return main(["calibrate", "drive", *map(str, words)])


def test_a_short_drive_is_refused(scene: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = calibrate(short, "--rig", scene / "rig.toml", "-o", tmp_path / "rig.toml")
    assert code == 2 and "take a longer drive" in capsys.readouterr().err
    assert not (tmp_path / "rig.toml").exists()


def test_exchanged_cameras_are_refused(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = read_rig(scene / "rig.toml")
    lower, upper = rig.topics
    code = calibrate(
        scene / "log.mcap", "--rig", scene / "rig.toml", "-o", tmp_path / "rig.toml", "--lower", upper, "--upper", lower
    )
    assert code == 2 and len(capsys.readouterr().err.splitlines()) < 6
    assert not (tmp_path / "rig.toml").exists()


def test_a_rig_that_fits_as_well_as_any_is_kept(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A height that is given is written all the same, and one by the floor where the rig states none."""
    as_good = SimpleNamespace(is_better=False, lines=lambda: [])
    monkeypatch.setattr("omnid.commands.calibrate_drive.calibrate_drive", lambda *_: as_good)
    rig = read_rig(scene / "rig.toml")
    write_rig(tmp_path / "high.toml", rig.at_height(0.9))
    out = tmp_path / "out.toml"
    assert calibrate(scene / "log.mcap", "--rig", tmp_path / "high.toml", "-o", out) == 1
    printed = capsys.readouterr().out
    assert "fits these drives as well as any rig" in printed and printed.endswith("nothing was written\n")
    assert "of 16 headings of a turn" in printed and not out.exists()
    assert calibrate(scene / "log.mcap", "--rig", scene / "rig.toml", "-o", out, "--height-m", "0.9") == 0
    assert read_rig(out).height_m() == pytest.approx(0.9)
    assert calibrate(scene / "log.mcap", "--rig", scene / "rig.toml", "-o", out) == 0
    assert "by the floor in" in capsys.readouterr().out and read_rig(out).height_m() == pytest.approx(1.2, abs=0.08)


def disturbed(mounted: MountedCamera, sign: float) -> MountedCamera:
    """Return the camera with its focal length 0.1 %, its centre 0.3 px and xi 0.5 % off; the horizon stays."""
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera)
    xi = camera.xi * (1 + sign * 0.005)
    focal = tuple(f * (1 + sign * 0.001) * xi / camera.xi for f in camera.focal)
    centre = (camera.center[0] + 0.3, camera.center[1] - sign * 0.3)
    return replace(mounted, camera=replace(camera, xi=xi, focal=(focal[0], focal[1]), center=centre))


def errors(folder: Path, rig: Rig | Path) -> tuple[float, float]:
    """Return the relative error of length and the ATE [m] of a replay with a rig."""
    result = replay(folder / "log.mcap", rig=rig)
    result.save_tum(folder / "estimate.txt")
    found = evaluate(read_tum(folder / "estimate.txt"), read_tum(folder / "truth.txt"))
    return found.length_error_ratio, found.ate_rmse_m


@pytest.mark.slow
def test_a_disturbed_rig_is_put_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Calibrate on a round through a room, drive between two walls: another log of the same rig."""
    for name in ("rooms", "two_walls"):
        run = build(name, 6)
        write_log(tmp_path / name, run.rig, run.poses, run.scene, sensor=run.sensor, seed=6)
    truth = read_rig(tmp_path / "rooms" / "rig.toml")
    wrong = replace(truth, lower=disturbed(truth.lower, 1.0), upper=disturbed(truth.upper, -1.0))
    write_rig(tmp_path / "wrong.toml", wrong)
    code = calibrate(tmp_path / "rooms" / "log.mcap", "--rig", tmp_path / "wrong.toml", "-o", tmp_path / "better.toml")
    assert code == 0 and "lengths change by" in capsys.readouterr().out
    before, after = (errors(tmp_path / "two_walls", tmp_path / name) for name in ("wrong.toml", "better.toml"))
    # The bound of the ATE is loose: 2.8 mm were measured with patches of planes, below 2 mm before; the cause is not
    # known. It counts from the first pose, so the direction of the rig frame is part of it.
    assert abs(after[0]) < 8e-4 and after[1] < 4e-3 < before[1]
    assert np.isclose(read_rig(tmp_path / "better.toml").baseline_m, truth.baseline_m)


@pytest.mark.slow
def test_a_nominal_rig_with_real_mirrors_becomes_useful(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cameras tilted by 0.7 degree below mirrors off shape; start: data sheet, rims, ruler. Another drive is tried."""
    for name, pairs in (("rooms", 100), ("two_walls", 60)):
        run = build(name, 15, pairs=pairs)
        write_log(tmp_path / name, with_real_mirrors(run.rig, 15), run.poses, run.scene, sensor=run.sensor, seed=15)
    code = calibrate(
        tmp_path / "rooms" / "log.mcap", "--rig", tmp_path / "rooms" / "nominal.toml", "-o", tmp_path / "better.toml"
    )
    assert code == 0 and "scale uncertain by" in capsys.readouterr().out
    length, ate_m = errors(tmp_path / "two_walls", tmp_path / "better.toml")
    assert abs(length) < 3e-3 and ate_m < 8e-3
    assert read_rig(tmp_path / "better.toml").covariance is not None
