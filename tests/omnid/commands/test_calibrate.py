"""`omnid calibrate rig|live|drive|import`: rigs from rendered boards, drives and files; refusals in one line."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from omnid import replay
from omnid.cli import main
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.ray_caster import Sensor
from tests.calib.test_importers import BOTH, NAMED, T_UPPER_LOWER, chain
from tests.calib.test_importers import TEXT as OCAM
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.replay.command import Command
from tests.replay.edited import images, save
from tests.simulation import build, write_log
from tests.simulation.boards import BoardRenderer, board_poses_around_rig
from tests.simulation.rigs import with_real_mirrors

BOARD = Board(7, 6, 0.03)
T_BETWEEN = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])
PAIRS = 6


def rig_of(size: int) -> Rig:
    """Return a rig whose upper camera is rotated about every axis, with images of size x size."""
    scale, mounted = size / 768, []
    for xi, focal, center, T in (
        (0.93, (-205.0, 206.2), (384.2, 380.9), np.eye(4)),
        (0.97, (-208.0, 207.2), (381.2, 385.9), T_BETWEEN),
    ):
        u, v = center[0] * scale, center[1] * scale
        camera = UnifiedCamera(xi, (focal[0] * scale, focal[1] * scale), (u, v), (size, size))
        mounted.append(MountedCamera(camera, T, Mask((u, v), 50 * scale, 372 * scale)))
    return Rig(mounted[0], mounted[1])


TRUTH = rig_of(480)


def render_pairs(rig: Rig, folder: Path, count: int) -> Path:
    """Render pairs of images of a board on all sides."""
    renderers = {"lower": BoardRenderer(BOARD, rig.lower), "upper": BoardRenderer(BOARD, rig.upper)}
    for seed, T in enumerate(board_poses_around_rig(rig, BOARD, count, distance_m=(0.2, 0.42))):
        for name, renderer in renderers.items():
            rendered = renderer.render_board(T, seed=seed, sensor=Sensor(noise_sigma=1.0))
            cv2.imwrite(str(folder / f"{name}_{seed:02d}.png"), rendered.image)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render six pairs of small images."""
    return render_pairs(TRUTH, tmp_path_factory.mktemp("pairs"), PAIRS)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render sixteen pairs of larger images."""
    return render_pairs(rig_of(640), tmp_path_factory.mktemp("many"), 16)


def run(*words: object, corners: str = "7x6", square_mm: float = 30) -> int:
    board = ["--corners", corners, "--square-mm", str(square_mm), "--quiet", "--view", "mirror"]
    return main(["calibrate", "rig", *board, *map(str, words)])


def between(rig: Rig) -> Array:
    return np.asarray(rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig))


def turn_off_deg(rig: Rig) -> float:
    """Return the error of the upper camera's rotation, whose frame is that of an ocam camera: x down, not against u."""
    T_omni_ocam = se3.transform(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    gap = se3.inverse(T_BETWEEN) @ T_omni_ocam @ between(rig) @ se3.inverse(T_omni_ocam)
    return float(np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3]))))


@pytest.mark.slow
def test_images_give_the_true_cameras_and_rig(many: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, report = tmp_path / "rig.toml", tmp_path / "report.html"
    assert run(many, "-o", out, "--report", report, "--expected-baseline-mm", "180") == 0
    output = capsys.readouterr()
    assert "16 pairs" in output.out and "the board is bent by 0.0" in output.out and "angle from the axis" in output.out
    assert output.err == ""
    found = read_rig(out)
    assert turn_off_deg(found) < 0.06 and found.baseline_m == pytest.approx(TRUTH.baseline_m, abs=3e-4)
    for mounted, truth in ((found.lower, rig_of(640).lower), (found.upper, rig_of(640).upper)):
        assert mounted.camera.center == pytest.approx(truth.camera.center, abs=0.1)
        assert mounted.mask is not None and mounted.mask.outer_px == pytest.approx(310, abs=3)
    page = report.read_text()
    # The corners of each camera.
    assert page.count("data:image/jpeg;base64,") == 2 and "Baseline 180" in page


def test_views_of_one_camera_are_used_and_exchanged_cameras_are_a_warning(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of exchanged cameras the rig would be upside down: its z, and with it every turn and every height."""
    for path in folder.glob("*.png"):
        side, number = path.stem.split("_")
        shutil.copy(path, tmp_path / f"{'upper' if side == 'lower' else 'lower'}_{number}.png")
    (tmp_path / "upper_04.png").unlink()
    cv2.imwrite(str(tmp_path / "lower_05.png"), np.full((480, 480), 90, np.uint8))
    assert run(tmp_path, "-o", tmp_path / "rig.toml", "--report", tmp_path / "report.html") == 0
    output, found = capsys.readouterr(), read_rig(tmp_path / "rig.toml")
    assert "4 pairs, 2 views of one camera alone; drives: scale uncertain by " in output.out
    assert "exchange their images, unless the cameras look down into their mirrors" in output.err
    assert found.covariance is not None and "upper a2" in found.covariance.names
    assert abs(found.baseline_m - TRUTH.baseline_m) < 4 * found.covariance.select(["baseline"]).sigmas[0] < 8e-3


def test_images_without_a_board_are_one_line_and_exit_code_2(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(3):
        shutil.copy(folder / f"lower_{k:02d}.png", tmp_path)
        cv2.imwrite(str(tmp_path / f"upper_{k:02d}.png"), np.full((480, 480), 90, np.uint8))
    assert run("-o", tmp_path / "rig.toml", tmp_path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no board of 7x6 inner corners in any of 3 images of the upper camera" in line
    assert not (tmp_path / "rig.toml").exists()
    (tmp_path / "rig.toml").touch()
    assert run("-o", tmp_path / "rig.toml", tmp_path) == 2 and "exists: --replace" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--corners", "6x5"], "--board checkerboard: expected --corners, --square-mm"),
        (["--corners", "6x5", "--square-mm", "30"], "add --view mirror or direct"),
        (["--corners", "8x6", "--square-mm", "30"], "looks the same upside down"),
        (["--board", "aprilgrid", "--tags", "6x6", "--tag-mm", "80", "--tag-spacing", "24"], "Kalibr's tagSpacing"),
    ],
)
def test_the_error_names_what_is_wrong_with_the_board(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "rig", str(tmp_path), *words, "-o", str(tmp_path / "rig.toml")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


OPTIONS = ("--corners", "7x6", "--square-mm", "30")
LIVE_PAIRS = 2  # of different places


def image(folder: Path, name: str) -> Array:
    """Return an image of a folder."""
    found: Array = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    return found


@pytest.fixture(scope="module")
def larger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_pairs(rig_of(640), tmp_path_factory.mktemp("pairs"), LIVE_PAIRS)


def test_live_writes_what_it_keeps_and_goes_on_where_it_ended(
    larger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    omnid, kept = Command(capsys), tmp_path / "kept"
    names = ("00", "00", "00", "01", "01")  # moving, kept, seen before, moving, kept
    pairs = [tuple(image(larger, f"{side}_{name}") for side in ("lower", "upper")) for name in names]
    pairs += [(np.zeros_like(pairs[0][0]),) * 2, (pairs[0][0], np.zeros_like(pairs[0][0]))]  # no board, one camera
    monkeypatch.setattr("omnid.commands.options.device_opener", lambda _: lambda _: io.BytesIO())
    monkeypatch.setattr("omnid.commands.calibrate.newest_pairs", lambda *_: pairs)
    words = ("calibrate", "live", kept, *OPTIONS, "--set", f'bus.listen=["{free_endpoint()}"]')
    first = omnid(*words)
    assert first.code == 1 and f"{LIVE_PAIRS} pairs, not enough yet: {15 - LIVE_PAIRS} more positions" in first.err
    assert sorted(path.name for path in kept.iterdir())[::LIVE_PAIRS] == ["lower_001.png", "upper_001.png"]
    np.testing.assert_array_equal(image(kept, "upper_002"), image(larger, "upper_01"))
    again = omnid(*words)
    assert again.out == "" and f"{LIVE_PAIRS} pairs, not enough yet" in again.err
    assert len(list(kept.iterdir())) == 2 * LIVE_PAIRS


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


def test_a_rig_that_fits_as_well_as_any_is_kept(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A height that is given is written all the same, and one by the floor where the rig states none."""
    as_good = SimpleNamespace(is_better=False)
    monkeypatch.setattr("omnid.commands.calibrate.calibrate_drive", lambda *_: as_good)
    rig = read_rig(scene / "rig.toml")
    write_rig(tmp_path / "high.toml", rig.at_height(0.9))
    out = tmp_path / "out.toml"
    assert calibrate(scene / "log.mcap", "--rig", tmp_path / "high.toml", "-o", out) == 1
    printed = capsys.readouterr().out
    assert "fits this drive as well as any rig" in printed and printed.endswith("nothing was written\n")
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


def import_rig(*words: object) -> int:
    return main(["calibrate", "import", *map(str, words)])


@pytest.fixture
def kalibr(tmp_path: Path) -> Path:
    """A camchain.yaml."""
    (tmp_path / "k.yaml").write_text(chain(BOTH, T_UPPER_LOWER, NAMED))
    return tmp_path / "k.yaml"


def test_kalibr_files_are_imported(kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert import_rig(kalibr, "-o", tmp_path / "rig.toml") == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "lower omni, upper omni, " in line
    assert "baseline 201.2 mm, upper rotated by 17.4" in line and "no height of the cameras (--height-m" in line
    assert import_rig(kalibr, "--lower", "cam1", "-o", tmp_path / "swapped.toml", "--height-m", 0.8) == 0
    swapped = read_rig(tmp_path / "swapped.toml")
    assert swapped.topics == NAMED[::-1] and swapped.height_m() == pytest.approx(0.8)
    for wrong in ("0", "nan"):
        with pytest.raises(SystemExit):
            import_rig(kalibr, "-o", tmp_path / "rig.toml", "--height-m", wrong)
        assert "--height-m: expected 0.1 to 10" in capsys.readouterr().err


def test_ocam_files_are_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.txt").write_text(OCAM)
    files = ["--lower", tmp_path / "c.txt", "--upper", tmp_path / "c.txt", "-o", tmp_path / "rig.toml"]
    assert import_rig(*files) == 2 and "--baseline METRES" in capsys.readouterr().err
    assert import_rig(*files, "--baseline", 0.2, "--view", "direct") == 0
    assert "upper ocam, direct view, " in (line := capsys.readouterr().out)
    assert "baseline 200.0 mm, upper rotated by 0.00 deg" in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("none.yaml", "-o", "no/rig.toml"), "there is no folder"),
        (("none.yaml", "-o", "rig.toml"), "cannot be read"),
        (("k.yaml", "-o", "k.yaml"), "that is read as well"),
        (("k.yaml", "--baseline", 0.2, "-o", "rig.toml"), "expected a Kalibr camchain.yaml"),
        (("--equirectangular", "1920x960", "-o", "rig.toml"), "with --baseline METRES"),
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
    assert import_rig(*words) == 2
    assert message in capsys.readouterr().err and sorted(kalibr.parent.iterdir()) == before


def test_a_rig_is_replaced_where_that_is_asked_for(
    kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.toml"
    assert import_rig(kalibr, "-o", rig, "--height-m", 0.8) == 0
    assert import_rig(kalibr, "-o", rig) == 2 and "exists: --replace" in capsys.readouterr().err
    assert read_rig(rig).height_m() == pytest.approx(0.8)
    assert import_rig(kalibr, "-o", rig, "--replace") == 0
    assert read_rig(rig).height_m() is None
