"""Damaged input: usable parts are used, losses are counted, and files that exist are kept."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.logs.mcap_writer import LogWriter
from omnid.sinks.files import check_outputs, write_trajectory
from tests.conftest import PAIRS
from tests.replay.command import Command, rows
from tests.replay.edited import images, save


def test_on_a_full_disk_only_files_that_are_there_are_named(omnid: Command, tmp_path: Path, scene: Path) -> None:
    plan = tmp_path / "plan.png"
    code, out, err = omnid.replay(scene / "log.mcap", "--tum", "/dev/full", "--plan", plan, rig=scene / "rig.toml")
    assert code == 2 and "/dev/full: can no longer be written: No space left on device" in err
    assert "written" not in out and ("plan.png" in out) == plan.exists() and "cut short /dev/full" in out


def test_uses_the_readable_part_of_a_truncated_log(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log, tum = save(tmp_path / "log.mcap", images(scene / "log.mcap")), tmp_path / "est.txt"
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) * 6 // 10])
    code, out, err = result = omnid.replay(log, "--tum", tum, rig=scene / "rig.toml")
    assert code == 0 and err.startswith("omnid: warning: ") and "cut" in err, out
    assert PAIRS // 3 < result.count("pairs") < PAIRS
    assert len(rows(tum)) == result.count("pairs")


def test_skips_and_counts_broken_jpegs(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    broken = {0: b"no image at all", 20: taken[20].jpeg[: len(taken[20].jpeg) // 2]}
    log = save(tmp_path / "log.mcap", [replace(p, jpeg=broken.get(i, p.jpeg)) for i, p in enumerate(taken)])
    result = omnid.replay(log, "--tum", tmp_path / "est.txt", rig=scene / "rig.toml")
    assert result.code == 0 and result.count("broken") == 2
    assert result.count("unpaired_lower") + result.count("unpaired_upper") == 2
    assert len(rows(tmp_path / "est.txt")) == result.count("pairs") == PAIRS - 2


def test_warns_if_all_jpegs_are_broken(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log = save(tmp_path / "log.mcap", [replace(p, jpeg=b"\xff\xd8\xff?") for p in images(scene / "log.mcap")])
    result = omnid.replay(log, "--tum", tmp_path / "t", "--cloud", tmp_path / "m", rig=scene / "rig.toml")
    assert result.code == 1 and result.count("broken") == 2 * PAIRS and result.count("pairs") == 0
    assert "no pair of images" in result.err


def test_counts_duplicate_images_and_orders_late_ones(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    late, rest = replace(taken[2], written_ns=taken[46].stamp_ns), taken[:2] + taken[3:]
    log = save(tmp_path / "log.mcap", [*rest[:8], rest[7], *rest[8:45], late, *rest[45:]])
    result = omnid.replay(log, rig=scene / "rig.toml")
    assert result.code == 0 and "warning" in result.err
    assert (result.count("duplicate"), result.count("pairs")) == (1, PAIRS)


def test_a_file_that_another_run_writes_is_no_output(omnid: Command, tmp_path: Path, scene: Path) -> None:
    """Two runs with one file would leave a recording that neither can be read from."""
    mcap, tum = tmp_path / "run.mcap", tmp_path / "run.txt"

    def errors() -> Iterator[str]:
        for option, path in (("--record", mcap), ("--tum", tum)):
            yield omnid.refused("replay", scene / "log.mcap", "--rig", scene / "rig.toml", option, path)

    def poses() -> Iterator[NDArray[np.float64]]:
        yield np.eye(4)
        assert all("another program is writing it" in error for error in errors())
        yield np.eye(4)

    with LogWriter(mcap):
        write_trajectory(tum, np.arange(2), poses())  # type: ignore[arg-type]
    assert len(rows(tum)) == 2 and omnid("log", "info", mcap).code == 0
    assert omnid.replay(scene / "log.mcap", "--tum", tum, "--seconds", 0.1, rig=scene / "rig.toml").code == 0


def test_does_not_overwrite_its_inputs(omnid: Command, tmp_path: Path, scene: Path) -> None:
    bag, rig, settings = tmp_path / "bag", tmp_path / "rig.toml", tmp_path / "omnid.toml"
    bag.mkdir()
    shutil.copy(scene / "log.mcap", bag / "bag_0.mcap")
    os.link(bag / "bag_0.mcap", tmp_path / "link.mcap")
    shutil.copy(scene / "rig.toml", rig)
    settings.write_text(omnid("config").out)
    before = {path: path.read_bytes() for path in (bag / "bag_0.mcap", rig, settings)}
    for path, what in (
        (bag / "bag_0.mcap", "log"),
        (tmp_path / "link.mcap", "log"),
        (rig, "rig"),
        (settings, "configuration"),
    ):
        error = omnid.refused("replay", bag, "--rig", rig, "--config", settings, "--quiet", "--record", path)
        assert f"the {what} that is read" in error
    assert {path: path.read_bytes() for path in before} == before


def test_a_log_of_a_folder_that_is_read_is_no_output(omnid: Command, tmp_path: Path) -> None:
    read = tmp_path / "bag_0.db3"
    read.write_text("0.1")
    assert f"this is a file of {tmp_path}, which is read" in omnid.refused("replay", tmp_path, "--tum", read)
    assert read.read_text() == "0.1"
    for option, mine in (("--tum", "est.txt"), ("--plan", "plan.png")):  # of the run before
        (tmp_path / mine).write_text("before")
        check_outputs([(option, tmp_path / mine)], [("the log that is read", tmp_path)])


def test_a_run_without_a_pair_keeps_existing_files(omnid: Command, tmp_path: Path, scene: Path) -> None:
    """It is refused at the first image, or it ends without one."""
    rig = (scene / "rig.toml").read_text().replace("size = [256, 256]", "size = [640, 640]")
    (tmp_path / "other.toml").write_text(rig)
    kept = {option: tmp_path / option for option in ("--tum", "--cloud", "--plan", "--record")}
    for path in kept.values():
        path.write_text("previous result")
    files = [word for option, path in kept.items() for word in (option, path)]
    omnid.refused("replay", scene / "log.mcap", "--quiet", "--rig", tmp_path / "other.toml", *files)
    save(tmp_path / "log.mcap", [replace(p, jpeg=b"\xff\xd8\xff?") for p in images(scene / "log.mcap")])
    omnid.replay(tmp_path / "log.mcap", *files, rig=scene / "rig.toml")
    assert [path.read_text() for path in kept.values()] == ["previous result"] * 4


def test_an_output_through_a_link_keeps_the_link(omnid: Command, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert omnid.replay(scene / "log.mcap", "--tum", tmp_path / "link", rig=scene / "rig.toml").code == 0
    assert (tmp_path / "link").is_symlink() and len(rows(tmp_path / "real")) == PAIRS
