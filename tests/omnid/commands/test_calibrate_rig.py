"""`omnid calibrate rig`: rig.toml and report from rendered pairs of images; one-line errors."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calib import se3
from calib.boards.board import Board
from calib.camera_file import CameraFile, camera_toml
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.simulation.rendering.sensor import Sensor
from tests.simulation.boards import BoardRenderer, board_poses_around_rig

BOARD = Board(7, 6, 0.03)
T_UPPER_LOWER = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])
PAIRS = 6


def rig_of(size: int) -> Rig:
    """Return a rig whose upper camera is rotated about every axis, with images of size x size."""
    scale, mounted = size / 768, []
    for xi, focal, center, T in (
        (0.93, (-205.0, 206.2), (384.2, 380.9), np.eye(4)),
        (0.97, (-208.0, 207.2), (381.2, 385.9), T_UPPER_LOWER),
    ):
        u, v = center[0] * scale, center[1] * scale
        camera = UnifiedCamera(xi, (focal[0] * scale, focal[1] * scale), (u, v), (size, size))
        mounted.append(MountedCamera(camera, T, Mask((u, v), 50 * scale, 372 * scale)))
    return Rig(mounted[0], mounted[1])


TRUTH = rig_of(480)
LOWER, UPPER = TRUTH.lower.camera, TRUTH.upper.camera


def render_pairs(rig: Rig, folder: Path, count: int) -> Path:
    """Render pairs of images of a board on all sides, and write the cameras' files."""
    renderers = {"lower": BoardRenderer(BOARD, rig.lower), "upper": BoardRenderer(BOARD, rig.upper)}
    for seed, T in enumerate(board_poses_around_rig(rig, BOARD, count, distance_m=(0.2, 0.42))):
        for name, renderer in renderers.items():
            rendered = renderer.render_board(T, seed=seed, sensor=Sensor(noise_sigma=1.0))
            cv2.imwrite(str(folder / f"{name}_{seed:02d}.png"), rendered.image)
    for name, mounted in (("lower", rig.lower), ("upper", rig.upper)):
        (folder / f"{name}.toml").write_text(camera_toml(CameraFile(mounted.camera, mounted.mask)))
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
    return main(["calibrate", "rig", *map(str, words), "--corners", corners, "--square-mm", str(square_mm), "--quiet"])


@pytest.fixture
def four(folder: Path, tmp_path: Path) -> Path:
    """Return a folder with the first four pairs."""
    made = tmp_path / "four"
    made.mkdir()
    for path in folder.glob("*_0[0-3].png"):
        shutil.copy(path, made)
    return made


def given(folder: Path) -> list[object]:
    return ["--lower-camera", folder / "lower.toml", "--upper-camera", folder / "upper.toml"]


def between(rig: Rig) -> Array:
    return np.asarray(rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig))


def turn_off_deg(rig: Rig) -> float:
    gap = se3.inverse(T_UPPER_LOWER) @ between(rig)
    return float(np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3]))))


@pytest.mark.slow
def test_recovers_cameras_and_rig_from_images(many: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, report = tmp_path / "rig.toml", tmp_path / "report.html"
    assert run(many, "-o", out, "--model", "omni", "--report", report, "--expected-baseline-mm", "180") == 0
    output = capsys.readouterr()
    assert output.out.count("\n") == 2 and "16 pairs" in output.out
    # No board was above the horizon, where a drive looks, too.
    assert output.err.count("\n") == 1 and "with the board higher, all around" in output.err
    found = read_rig(out)
    assert turn_off_deg(found) < 0.02 and found.baseline_m == pytest.approx(TRUTH.baseline_m, abs=3e-4)
    for mounted, truth in ((found.lower, rig_of(640).lower.camera), (found.upper, rig_of(640).upper.camera)):
        assert isinstance(mounted.camera, UnifiedCamera) and isinstance(truth, UnifiedCamera)
        assert mounted.camera.center == pytest.approx(truth.center, abs=0.1)
        assert mounted.camera.focal == pytest.approx(truth.focal, rel=5e-4)
        assert mounted.mask is not None and mounted.mask.outer_px == pytest.approx(310, abs=3)
    page = report.read_text()
    # The panoramas, the corners of each camera, and the residuals of each pair.
    assert page.count("data:image/jpeg;base64,") == 1 + 2 + 2 * 16 and "Baseline 180" in page and "r_x" in page


@pytest.mark.slow
def test_recovers_the_rig_with_the_polynomial_model(many: Path, tmp_path: Path) -> None:
    assert run(many, "-o", tmp_path / "rig.toml", "--mask", "--model", "ocam") == 0
    found = read_rig(tmp_path / "rig.toml")
    assert found.baseline_m == pytest.approx(TRUTH.baseline_m, abs=3e-4)
    T_omni_ocam = se3.transform(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))  # x down, not against u
    gap = se3.inverse(T_UPPER_LOWER) @ T_omni_ocam @ between(found) @ se3.inverse(T_omni_ocam)
    assert np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3]))) < 0.06
    assert found.lower.mask is not None and found.lower.mask.image is not None
    assert (tmp_path / "rig.lower.png").exists()


@pytest.fixture
def alone(folder: Path, tmp_path: Path) -> Path:
    """Return the pairs, without one upper image, and with a blank lower image of another pair."""
    for path in folder.glob("*.png"):
        shutil.copy(path, tmp_path)
    (tmp_path / "upper_04.png").unlink()
    cv2.imwrite(str(tmp_path / "lower_05.png"), np.full((480, 480), 90, np.uint8))
    return tmp_path


def test_views_of_one_camera_are_used_if_cameras_are_refined(
    folder: Path, alone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*given(folder), "--refine-cameras", "--report", alone / "report.html"]
    assert run(alone, "-o", alone / "rig.toml", *words) == 0
    output = capsys.readouterr()
    assert "4 pairs, 2 views of one camera alone; drives: scale uncertain by 0." in output.out
    assert "the images leave something open: drives may be wrong by" in output.err and output.err.count("\n") == 1
    found = read_rig(alone / "rig.toml")
    assert "not seen" in (alone / "report.html").read_text() and turn_off_deg(found) < 0.05
    assert found.covariance is not None and "upper fv" in found.covariance.names
    assert abs(found.baseline_m - TRUTH.baseline_m) < 4 * found.covariance.sigma("baseline") < 4e-3


def test_given_cameras_are_kept_and_single_views_rejected(
    folder: Path, alone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(alone, "-o", alone / "rig.toml", *given(folder), "--expected-baseline-mm", 184) == 0
    found, output = read_rig(alone / "rig.toml"), capsys.readouterr()
    assert found.lower.camera == LOWER and found.upper.camera == UPPER and found.lower.mask == TRUTH.lower.mask
    assert turn_off_deg(found) < 0.02 and found.baseline_m == pytest.approx(TRUTH.baseline_m, abs=3e-4)
    assert output.out.splitlines()[0].endswith("4 pairs")
    baseline, *left_out = output.err.splitlines()
    assert baseline.startswith("warning: the baseline of 180.") and "off the expected 184 mm" in baseline
    assert [line[:45] for line in left_out] == [
        "warning: left out 04: only the lower camera s",
        "warning: left out 05: only the upper camera s",
    ]


def log_of(folder: Path, path: Path) -> None:
    """Write the pairs as PNG messages, the upper camera 2 ms later, with an unpaired image between."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds, schema = store.types, "sensor_msgs/msg/CompressedImage"
    with LogWriter(path) as writer:
        for k in range(PAIRS):
            for name, late_ns in (("lower", 0), ("upper", 2_000_000), ("upper", 50_000_000))[: 2 + (k == 3)]:
                data = np.frombuffer((folder / f"{name}_{k:02d}.png").read_bytes(), np.uint8)
                header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](k + 1, late_ns), name)
                cdr = store.serialize_cdr(kinds[schema](header, "png", data), schema)
                writer.write(f"/{name}/image", schema, bytes(cdr), (k + 1) * 10**9 + late_ns)


def test_pairs_a_log_by_its_stamps(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log_of(folder, tmp_path / "log.mcap")
    assert run(tmp_path / "log.mcap", "-o", tmp_path / "rig.toml", *given(folder)) == 0
    assert re.search(r"[56] pairs\n", capsys.readouterr().out)
    found = read_rig(tmp_path / "rig.toml")
    assert found.topics == ("/lower/image", "/upper/image") and turn_off_deg(found) < 0.02


def bad(folder: Path, made: Path, kind: str) -> list[object]:
    """Return arguments with invalid input: a folder of three pairs with a fault."""
    blank = np.full((480, 480), 90, np.uint8)
    for name in ("lower", "upper"):
        for k in range(3):
            shutil.copy(folder / f"{name}_{k:02d}.png", made)
    match kind:
        case "blank":
            for path in made.glob("upper_*"):
                cv2.imwrite(str(path), blank)
        case "sizes":
            cv2.imwrite(str(made / "upper_09.png"), blank[:300])
        case "text":
            (made / "lower_09.png").write_text("no image")
        case "one side":
            for path in made.glob("upper_*"):
                path.unlink()
        case "unpaired":
            for path in made.glob("upper_*"):
                path.rename(made / path.name.replace("_0", "_1"))
        case "missing":
            return [made / "none"]
        case "size of camera":
            text = (folder / "lower.toml").read_text().replace("size = [480, 480]", "size = [640, 480]")
            (made / "lower.toml").write_text(text)
            return [made, "--lower-camera", made / "lower.toml", "--upper-camera", folder / "upper.toml"]
        case "one camera":
            return [made, "--lower-camera", folder / "lower.toml"]
        case "topic":
            return [made, "--lower", "/x"]
    return [made]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("three", "expected at least 4 views of the board, found 3"),
        ("blank", "upper camera: calibrate: no board of 7x6 inner corners in any of 3 images"),
        ("sizes", "all of one size, found 480x480"),
        ("text", "lower_09.png: expected an image"),
        ("one side", "no images upper_*"),
        ("unpaired", "no pair of images: found 3 of the lower camera, 3 of"),
        ("missing", "found no such file or folder"),
        ("one camera", "expected both --lower-camera and --upper-camera"),
        ("size of camera", "--lower-camera: expected a camera of 480x480 px like the lower images, found 640x480 px"),
        ("topic", "only a log has topics"),
    ],
)
def test_invalid_input_is_one_line_and_exit_code_2(
    folder: Path, tmp_path: Path, kind: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*bad(folder, tmp_path, kind), "-o", tmp_path / "rig.toml") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and not (tmp_path / "rig.toml").exists()


def test_exchanged_cameras_are_a_warning(folder: Path, four: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The rig would be upside down: its z, and with it every turn and every height."""
    for path in four.glob("*.png"):
        side, number = path.stem.split("_")
        path.rename(four / f"{'upper' if side == 'lower' else 'lower'}_{number}x.png")
    words = ["--lower-camera", folder / "upper.toml", "--upper-camera", folder / "lower.toml"]
    assert run(four, "-o", four / "rig.toml", *words) == 0
    assert "exchange their images, unless the cameras look down into their mirrors" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--output", "--report"])
def test_images_that_are_read_are_kept(four: Path, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    image = four / "lower_00.png"
    before = image.read_bytes()
    assert run(four, "-o", four / "rig.toml", option, image) == 2
    assert f"{option} {image}: this is a file of {four}, which is read" in capsys.readouterr().err
    assert image.read_bytes() == before


@pytest.mark.parametrize(
    ("square_mm", "words", "message"),
    [
        (30000, [], "squares of 0.1 mm to 10 m, found 30000 mm"),
        (30, ["--expected-baseline-mm", "-4"], "expected a length above 0"),
    ],
)
def test_a_length_that_cannot_be_is_refused(
    folder: Path,
    four: Path,
    tmp_path: Path,
    square_mm: float,
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "rig.toml"
    assert run(four, "-o", out, *given(folder), *words, square_mm=square_mm) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and not out.exists()


def test_suggests_the_right_number_of_corners(
    folder: Path, four: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in four.glob("*_00.png"):
        shutil.copy(path, tmp_path)
    assert run(tmp_path, "-o", tmp_path / "rig.toml", *given(folder), corners="8x5") == 2
    assert "try --corners 6x7" in capsys.readouterr().err
