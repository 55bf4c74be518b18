"""`omnid calibrate camera`: camera.toml, report and mask from rendered images; one-line errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calib.boards.board import Board
from calib.camera_file import read_camera
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from tests.simulation.boards import BoardRenderer, board_poses_around_camera

BOARD = Board(6, 5, 0.03)
CAMERA = UnifiedCamera(0.9, (-110.0, 110.5), (178.3, 181.1), (360, 362))
MASK = Mask(CAMERA.center, 30.0, 172.0)
VIEWS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render six images of a board on all sides."""
    made = tmp_path_factory.mktemp("images")
    renderer = BoardRenderer.of(BOARD, CAMERA, MASK)
    for seed, T in enumerate(board_poses_around_camera(CAMERA, BOARD, MASK, VIEWS, distance_m=(0.14, 0.25))):
        cv2.imwrite(str(made / f"p{seed}.png"), renderer.render_board(T, seed=seed).image)
    return made


def run(*words: object, corners: str = "6x5") -> int:
    return main(["calibrate", "camera", *map(str, words), "--corners", corners, "--square-mm", "30", "--quiet"])


def test_writes_camera_report_and_mask(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, report, mask = (tmp_path / name for name in ("camera.toml", "report.html", "mask.png"))
    assert run(folder, "-o", out, "--report", report, "--mask", mask) == 0
    line = capsys.readouterr().out
    assert line.count("\n") == 1 and f"of {VIEWS} views" in line and "mean reprojection error 0.0" in line
    assert "model omni" in line and "MISFIT" not in line
    read = read_camera(out)
    assert isinstance(read.camera, UnifiedCamera)
    assert read.camera.center == pytest.approx(CAMERA.center, abs=0.3)
    assert read.mask is not None and read.mask.outer_px == pytest.approx(MASK.outer_px, abs=3)
    assert read.mask.inner_px == pytest.approx(MASK.inner_px, abs=4)
    page = report.read_text()
    assert page.count("data:image/jpeg;base64,") == VIEWS + 2 and "://" not in page
    assert all(f"p{number}.png" in page for number in range(VIEWS)) and "standard deviation" in page


@pytest.mark.slow
def test_calibrates_an_omni_camera_by_a_pattern_with_a_blank_image(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in folder.iterdir():
        shutil.copy(path, tmp_path)
    cv2.imwrite(str(tmp_path / "p9.png"), np.full((362, 360), 90, np.uint8))
    assert run(f"{tmp_path}/p*.png", "--model", "omni", "-o", tmp_path / "camera.toml") == 0
    assert f"of {VIEWS} views" in capsys.readouterr().out
    camera = read_camera(tmp_path / "camera.toml").camera
    assert isinstance(camera, UnifiedCamera) and camera.focal == pytest.approx(CAMERA.focal, rel=2e-3)


def log_of(folder: Path, path: Path, topics: tuple[str, ...]) -> None:
    """Write the images of a folder as PNG messages on every topic."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    with LogWriter(path) as writer:
        for number, image in enumerate(sorted(folder.iterdir())):
            header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](number + 1, 0), "camera")
            data = np.frombuffer(image.read_bytes(), np.uint8)
            message = kinds["sensor_msgs/msg/CompressedImage"](header, "png", data)
            cdr = store.serialize_cdr(message, "sensor_msgs/msg/CompressedImage")
            for topic in topics:
                writer.write(topic, "sensor_msgs/msg/CompressedImage", bytes(cdr), (number + 1) * 10**9)


@pytest.mark.slow
def test_calibrates_by_a_log_and_requires_the_topic(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log_of(folder, tmp_path / "log.mcap", ("/lower", "/upper"))
    assert run(tmp_path / "log.mcap", "-o", tmp_path / "camera.toml") == 2
    assert "expected --topic, to select the camera, found image topics /lower, /upper" in capsys.readouterr().err
    assert run(tmp_path / "log.mcap", "--topic", "/upper", "--model", "omni", "-o", tmp_path / "camera.toml") == 0
    assert f"of {VIEWS} views" in capsys.readouterr().out
    assert read_camera(tmp_path / "camera.toml").camera.center == pytest.approx(CAMERA.center, abs=0.3)


def bad_folder(tmp_path: Path, folder: Path, kind: str) -> list[object]:
    """Return arguments with invalid input."""
    three = [folder / f"p{number}.png" for number in range(3)]
    blank, other, text = tmp_path / "blank.png", tmp_path / "other.png", tmp_path / "notes.png"
    cv2.imwrite(str(blank), np.full((362, 360), 90, np.uint8))
    cv2.imwrite(str(other), np.full((300, 360), 90, np.uint8))
    text.write_text("no image")
    (tmp_path / "empty").mkdir(exist_ok=True)
    kinds: dict[str, list[object]] = {
        "blank": [blank],
        "three": [*three],
        "sizes": [*three, other],
        "text": [text],
        "empty": [tmp_path / "empty"],
        "none": [tmp_path / "none.png"],
        "topic": [*three, "--topic", "/x"],
        "log": [tmp_path / "none.mcap"],
    }
    return kinds[kind]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("blank", "no board of 6x5 inner corners in any of 1 images; count the inner corners"),
        ("three", "expected at least 4 views of the board, found 3; take more images"),
        ("sizes", "all of one size, found 360x362 (p0.png), 360x300 (other.png)"),
        ("text", "notes.png: expected an image"),
        ("empty", "no image"),
        ("none", "no such file"),
        ("topic", "only a log has topics"),
        ("log", "none.mcap"),
    ],
)
def test_invalid_input_is_one_line_and_exit_code_2(
    folder: Path, tmp_path: Path, kind: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*bad_folder(tmp_path, folder, kind), "-o", tmp_path / "camera.toml") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "camera.toml").exists()


@pytest.mark.parametrize("source", [".", "p*.png"])
def test_images_that_are_read_are_kept(
    folder: Path, tmp_path: Path, source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in folder.glob("p0.png"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = (tmp_path / "p0.png").read_bytes()
    assert run(tmp_path / source, "-o", tmp_path / "p0.png") == 2
    assert "which is read; name another file" in capsys.readouterr().err
    assert (tmp_path / "p0.png").read_bytes() == before


def test_suggests_the_right_number_of_corners(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder / "p0.png", "-o", tmp_path / "camera.toml", corners="7x4") == 2
    assert "a grid of 5x6 was found in 1: try --corners 5x6" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--corners", "6by5", "--square-mm", "30"]])
def test_invalid_options_are_one_line(
    folder: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "camera", str(folder), *words, "-o", str(tmp_path / "c.toml")])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert (
        main(
            [
                "calibrate",
                "camera",
                str(folder),
                "--corners",
                "6x5",
                "--square-mm",
                "-3",
                "-o",
                str(tmp_path / "c.toml"),
            ]
        )
        == 2
    )
    assert "squares of 0.1 mm to 10 m" in capsys.readouterr().err
