"""Printable boards, rendered by PDFium and found by OpenCV: true to scale, with a ruler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray

from omnid.cli import main

DPI = 254.0  # 10 px a millimetre
PX_PER_MM = DPI / 25.4


def printed(tmp_path: Path, *options: object) -> tuple[NDArray[np.uint8], str]:
    """The page as grey pixels, and its text."""
    path = tmp_path / "board.pdf"
    assert main(["calibrate", "board", *map(str, options), "-o", str(path)]) == 0
    page = pypdfium2.PdfDocument(path)[0]
    image = page.render(scale=DPI / 72, grayscale=True).to_numpy()
    return np.ascontiguousarray(image.reshape(image.shape[:2])), page.get_textpage().get_text_range()


def test_a_checkerboard_is_true_to_scale(tmp_path: Path) -> None:
    image, text = printed(tmp_path, "--corners", "6x7", "--square-mm", 25)
    assert image.shape == pytest.approx((2970, 2100), abs=1)
    found, corners = cv2.findChessboardCornersSB(image, (6, 7))
    assert found
    side = np.linalg.norm(np.diff(corners.reshape(7, 6, 2), axis=1), axis=2) / PX_PER_MM
    assert np.abs(side - 25).max() < 0.05
    assert "omnid calibrate rig LOG --corners 6x7 --square-mm 25" in text and "100 mm" in text
    # The ruler: the longest dark line in the foot of the page.
    foot = image[2600:] < 128
    longest_px = max(np.ptp(np.flatnonzero(row)) + 1 for row in foot if row.sum() > 900)
    assert longest_px / PX_PER_MM == pytest.approx(100, abs=0.2)


@pytest.mark.parametrize(
    ("options", "family", "border", "count", "side_mm"),
    [
        (
            ("--board", "charuco", "--corners", "5x7", "--square-mm", 30, "--marker-mm", 22, "--dictionary", "5X5_100"),
            cv2.aruco.DICT_5X5_100,
            1,
            24,
            22.0,
        ),
        (
            ("--board", "aprilgrid", "--tags", "6x6", "--tag-mm", 22, "--tag-spacing", 0.3),
            cv2.aruco.DICT_APRILTAG_36h11,
            2,
            36,
            22.0,
        ),
    ],
)
def test_markers_are_read_and_true_to_scale(
    tmp_path: Path, options: tuple[object, ...], family: int, border: int, count: int, side_mm: float
) -> None:
    image, _ = printed(tmp_path, *options)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(family), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    assert sorted(ids.ravel().tolist()) == list(range(count))
    sides = [np.linalg.norm(np.diff(four[0], axis=0), axis=1) / PX_PER_MM for four in corners]
    assert np.abs(np.array(sides) - side_mm).max() < 0.3


def test_a_board_that_does_not_fit_names_a_paper_that_does(tmp_path: Path) -> None:
    """Run the program as its users do."""
    command = [
        sys.executable,
        "-m",
        "omnid",
        "calibrate",
        "board",
        "--corners",
        "12x13",
        "--square-mm",
        "50",
        "-o",
        tmp_path / "board.pdf",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and "does not fit on a4" in done.stderr and "--paper a0" in done.stderr
    assert not (tmp_path / "board.pdf").exists()


def test_a_board_that_looks_the_same_when_turned_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("calibrate", "board", "--corners", "6x6", "--square-mm", "25", "-o", str(tmp_path / "board.pdf"))
    assert main(words) == 2 and not (tmp_path / "board.pdf").exists()
    assert "--corners 6x6: such a board looks the same when it is turned" in capsys.readouterr().err
