"""`omnid calibrate drive` and `omnid calibrate import`: refusals in one line, rigs that are written."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from calib import se3
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid import replay
from omnid.cli import main
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from tests.calib.test_importers import BOTH, NAMED, T_UPPER_LOWER, chain
from tests.calib.test_importers import TEXT as OCAM
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
    monkeypatch.setattr("omnid.commands.calibrate.calibrate_drive", lambda *_: as_good)
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


def errors(folder: Path, rig: Rig | Path) -> tuple[float, float]:
    """Return the relative error of length and the ATE [m] of a replay with a rig."""
    result = replay(folder / "log.mcap", rig=rig)
    result.save_tum(folder / "estimate.txt")
    found = evaluate(read_tum(folder / "estimate.txt"), read_tum(folder / "truth.txt"))
    return found.length_error_ratio, found.ate_rmse_m


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


def omnid(*words: object) -> int:
    return main(["calibrate", "import", *map(str, words)])


@pytest.fixture
def kalibr(tmp_path: Path) -> Path:
    """A camchain.yaml."""
    (tmp_path / "k.yaml").write_text(chain(BOTH, T_UPPER_LOWER, NAMED))
    return tmp_path / "k.yaml"


def test_imports_kalibr_files(kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert omnid(kalibr, "-o", tmp_path / "rig.toml") == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "lower omni 768x770 (/lower/image_raw), upper omni 768x770" in line
    assert "baseline 201.2 mm, upper rotated by 17.4" in line and "no height of the cameras (--height-m" in line
    assert omnid(kalibr, "--lower", "cam1", "-o", tmp_path / "swapped.toml", "--height-m", 0.8) == 0
    swapped = read_rig(tmp_path / "swapped.toml")
    assert swapped.topics == NAMED[::-1] and swapped.height_m() == pytest.approx(0.8)
    for wrong in ("0", "nan"):
        with pytest.raises(SystemExit):
            omnid(kalibr, "-o", tmp_path / "rig.toml", "--height-m", wrong)
        assert "--height-m: expected 0.1 to 10" in capsys.readouterr().err


def test_imports_ocam_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.txt").write_text(OCAM)
    (tmp_path / "T.txt").write_text("\n".join(" ".join(map(str, row)) for row in se3.inverse(T_UPPER_LOWER).tolist()))
    files = ["--lower", tmp_path / "c.txt", "--upper", tmp_path / "c.txt", "-o", tmp_path / "rig.toml"]
    assert omnid(*files, "--transform", tmp_path / "T.txt") == 0
    found = read_rig(tmp_path / "rig.toml")
    assert se3.apply(found.upper.T_cam_rig @ se3.inverse(found.lower.T_cam_rig), [[0.0, 0, 0]])[0] == pytest.approx(
        T_UPPER_LOWER[:3, 3], abs=1e-11
    )
    files.append("--replace")
    assert omnid(*files) == 2 and "--transform FILE or --baseline METRES" in capsys.readouterr().err
    assert omnid(*files, "--baseline", 0.2, "--view", "direct") == 0
    assert "upper ocam, direct view 640x480" in (line := capsys.readouterr().out)
    assert "baseline 200.0 mm, upper rotated by 0.00 deg" in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("none.yaml", "-o", "no/rig.toml"), "there is no folder"),
        (("k.yaml", "-o", "."), "expected a file to write, found a folder"),
        (("none.yaml", "-o", "rig.toml"), "cannot be read"),
        (("k.yaml", "-o", "k.yaml"), "that is read as well"),
        (("k.yaml", "--baseline", 0.2, "-o", "rig.toml"), "Kalibr's state them"),
        (("-o", "rig.toml"), "expected a Kalibr camchain.yaml, or two files of OCamCalib"),
        (("--equirectangular", "1920x960", "-o", "rig.toml"), "expected --baseline METRES"),
    ],
)
def test_invalid_requests_fail_before_files_are_written(
    words: tuple[object, ...],
    message: str,
    kalibr: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(kalibr.parent)
    before = sorted(kalibr.parent.iterdir())
    assert omnid(*words) == 2
    assert message in capsys.readouterr().err and sorted(kalibr.parent.iterdir()) == before


def test_a_rig_is_replaced_where_that_is_asked_for(
    kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.toml"
    assert omnid(kalibr, "-o", rig, "--height-m", 0.8) == 0
    assert omnid(kalibr, "-o", rig) == 2 and "exists: --replace" in capsys.readouterr().err
    assert read_rig(rig).height_m() == pytest.approx(0.8)
    assert omnid(kalibr, "-o", rig, "--replace") == 0
    assert read_rig(rig).height_m() is None
