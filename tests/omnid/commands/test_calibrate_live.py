"""`omnid calibrate live`: writes what it keeps, goes on where it ended, refuses other images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.omnid.calibration.test_live_boards import PAIRS, image
from tests.omnid.commands.test_calibrate_rig import render_pairs, rig_of
from tests.replay.command import Command

OPTIONS = ("--corners", "7x6", "--square-mm", "30")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_pairs(rig_of(640), tmp_path_factory.mktemp("pairs"), PAIRS)


def test_live_writes_what_it_keeps_and_goes_on_where_it_ended(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    omnid, kept = Command(capsys), tmp_path / "kept"
    first = omnid("calibrate", "live", kept, "--log", folder, *OPTIONS)
    assert first.code == 1 and f"{PAIRS} pairs, not enough yet: {15 - PAIRS} more positions" in first.err
    assert first.out.splitlines()[0].startswith("1: 14 more positions; both cameras: ")
    assert sorted(path.name for path in kept.iterdir())[::PAIRS] == ["lower_001.png", "upper_001.png"]
    np.testing.assert_array_equal(image(kept, "upper_002"), image(folder, "upper_01"))
    again = omnid("calibrate", "live", kept, "--log", folder, *OPTIONS)
    assert again.out == "" and f"{PAIRS} pairs, not enough yet" in again.err and len(list(kept.iterdir())) == 2 * PAIRS


def test_live_refuses_images_of_another_size(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in folder.iterdir():
        if path.stem.startswith("upper_"):
            cv2.imwrite(str(tmp_path / path.name), image(folder, path.stem)[:600, :500])
        elif path.stem.startswith("lower_"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    error = Command(capsys).refused("calibrate", "live", tmp_path, "--log", folder, *OPTIONS)
    assert "upper camera: expected images of 500x600 px as the first ones, found 640x640 px; " in error


def test_wrong_use_of_live_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    omnid = Command(capsys)
    assert "name a folder" in omnid.refused("calibrate", "live", *OPTIONS)
    assert "--square-mm" in omnid.refused("calibrate", "live", tmp_path, "--corners", "7x6")
    assert "/dev/no-camera" in omnid("calibrate", "live", tmp_path, *OPTIONS, "--lower", "/dev/no-camera").err
    (tmp_path / "file").touch()
    assert "name a folder" in omnid.refused("calibrate", "live", tmp_path / "file", *OPTIONS)
