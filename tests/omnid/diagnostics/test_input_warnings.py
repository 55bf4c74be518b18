"""Warnings about readable input that is wrong: exchanged cameras, clocks apart, darkness."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.rig_file import read_rig, write_rig
from omnid.formats.tum import read_tum
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import LOWER, UPPER
from tests.replay.command import Command
from tests.replay.edited import dark, images, save
from tests.simulation.rigs import with_upper_rotated

EXCHANGED = ("--lower", UPPER, "--upper", LOWER)


def test_exchanged_cameras_are_refused(omnid: Command, scene: Path) -> None:
    right = omnid.replay(scene / "log.mcap", rig=scene / "rig.toml")
    assert right.code == 0 and right.err == ""
    for words in ((), ("--inline",)):
        wrong = omnid.replay(scene / "log.mcap", *EXCHANGED, *words, rig=scene / "rig.toml")
        assert wrong.code == 2 and wrong.out == "" and wrong.err.count("\n") == 1
        assert "the other way round" in wrong.err and "--lower" in wrong.err


@pytest.mark.hazard("H35")
def test_a_rig_that_is_degrees_off_is_refused(omnid: Command, tmp_path: Path, scene: Path) -> None:
    for turn_deg in ((3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 0.0, 3.0)):
        write_rig(tmp_path / "rig.toml", with_upper_rotated(read_rig(scene / "rig.toml"), turn_deg))
        err = omnid.refused("replay", scene / "log.mcap", "--rig", tmp_path / "rig.toml", "--quiet")
        assert "turned by 3.0 deg" in err or "turned by 2.9 deg" in err
        assert "omnid calibrate drive --only check" in err


@pytest.mark.hazard("H34")
@pytest.mark.parametrize(("dead", "words"), [(("lower",), ()), (("lower", "upper"), ("--inline",))])
def test_pairs_of_a_frozen_camera_give_no_pose(
    omnid: Command, tmp_path: Path, scene: Path, dead: tuple[str, ...], words: tuple[str, ...]
) -> None:
    """Ten images repeat that of pair 7, with new stamps."""
    taken = images(scene / "log.mcap")
    last = {image.camera: image.jpeg for image in taken if image.pair == 7}
    frozen = [replace(p, jpeg=last[p.camera]) if p.camera in dead and 8 <= p.pair < 18 else p for p in taken]
    result = omnid.replay(
        save(tmp_path / "log.mcap", frozen), "--tum", tmp_path / "tum", *words, rig=scene / "rig.toml"
    )
    assert result.code == 1 and "10 of 24 pairs are missing" in result.err
    assert result.count("poses") == result.count("pairs") == PAIRS - 10 and result.count("repeated_lower") == 10
    assert [f"the {name} camera was frozen" in result.err for name in ("lower", "upper")] == [True, "upper" in dead]
    found, truth = read_tum(tmp_path / "tum"), read_tum(scene / "truth.txt")
    assert len(found.T) == PAIRS - 10 and found.stamps_ns[8] - found.stamps_ns[7] == 11 * 100_000_000
    moved_m = np.linalg.norm(found.T[9, :3, 3] - found.T[7, :3, 3])
    assert moved_m == pytest.approx(np.linalg.norm(truth.T[19, :3, 3] - truth.T[7, :3, 3]), abs=0.03)


def test_stamps_that_are_apart_give_a_warning(omnid: Command, tmp_path: Path, scene: Path) -> None:
    apart_ns = 12_000_000
    taken = [replace(p, stamp_ns=p.stamp_ns + apart_ns * (p.camera == "upper")) for p in images(scene / "log.mcap")]
    log, settings = save(tmp_path / "log.mcap", taken), ("pair.tolerance_ms=10", "log.time='header'")
    words = [word for setting in settings for word in ("--set", setting)]
    result = omnid.replay(log, *words, rig=scene / "rig.toml")
    assert result.code == 1 and "pair.tolerance_ms = 10 apart: correct the clocks" in result.err
    assert result.count("unpaired_lower") == result.count("unpaired_upper") == PAIRS


def test_a_pose_that_is_always_lost_gives_a_warning(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log = save(tmp_path / "log.mcap", map(dark, images(scene / "log.mcap")))
    result = omnid.replay(log, rig=scene / "rig.toml")
    assert result.code == 1 and f"lost in {PAIRS} of {PAIRS} pairs" in result.err
    assert f"too dark in {PAIRS} of {PAIRS} pairs" in result.err and "could not be checked" in result.err
