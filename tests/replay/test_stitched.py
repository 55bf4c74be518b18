"""Two stacked 360-degree cameras with stitched images in the layout of the data set Helvipad, by the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.importers import stacked_rig
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from tests.replay.command import Command
from tests.simulation import corridor, paths, render_grey, tum

PAIRS, START_NS, PERIOD_NS, BASELINE_M, SEED = 8, 1_706_000_000 * 10**9, 100_000_000, 0.191, 2
SIZE = (1920, 512)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with calibration.json, and the images of both cameras in folders, named by their stamps."""
    folder = tmp_path_factory.mktemp("helvipad")
    rig, poses, scene = stacked_rig(SIZE, BASELINE_M), paths.spline_path(SEED, PAIRS, 0.05), corridor(SEED)
    stamps = START_NS + PERIOD_NS * np.arange(PAIRS, dtype=np.int64)
    for name, mounted in (("images_bottom", rig.lower), ("images_top", rig.upper)):
        (folder / name).mkdir()
        sensor, rng = MountedSensor.of(Sensor(), mounted.visible, mounted.camera.size), np.random.default_rng(SEED)
        for stamp, T in zip(stamps.tolist(), poses, strict=True):
            image = sensor.expose(render_grey(scene, mounted, T, 1), rng)
            cv2.imwrite(str(folder / name / f"{stamp}.png"), image)
    (folder / "calibration.json").write_text(json.dumps({"stereo_baseline": 100 * BASELINE_M}))
    (folder / "truth.txt").write_text(tum(stamps, poses))
    return folder


def test_helvipad_is_imported_replayed_and_right_to_a_thousandth(
    recording: Path, tmp_path: Path, omnid: Command
) -> None:
    rig, found = tmp_path / "rig.toml", tmp_path / "out.txt"
    made = omnid(
        "calibrate", "import", recording / "calibration.json", "--lower", recording / "images_bottom", "-o", rig
    )
    assert made.code == 0 and "equirectangular 1920x512" in made.out and "baseline 191.0 mm" in made.out
    done = omnid("replay", recording, "--rig", rig, "--quiet", "--tum", found)
    assert done.code == 0 and "tracking 100.0%" in done.out and "rim" not in done.out + done.err, done
    errors = json.loads(omnid("eval", found, recording / "truth.txt", "--json").out)
    assert abs(errors["length_error_ratio"]) < 0.001 and errors["ate_rmse_m"] < 0.001, errors


def test_the_size_of_the_images_is_asked_for(tmp_path: Path, omnid: Command) -> None:
    rig = tmp_path / "rig.toml"
    assert "WIDTHxHEIGHT" in omnid.refused(
        "calibrate", "import", "--equirectangular", "big", "--baseline", "0.2", "-o", rig
    )
    assert "--baseline METRES" in omnid.refused("calibrate", "import", "--equirectangular", "1920x960", "-o", rig)
    assert not rig.exists()
    made = omnid("calibrate", "import", "--equirectangular", "1920x960", "--baseline", "0.2", "-o", rig)
    assert made.code == 0 and "baseline 200.0 mm" in made.out
