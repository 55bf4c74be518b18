"""Wrong input: usable parts are used and losses are counted, the rest is refused in one line."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.logs.mcap_writer import LogWriter
from omnid.sinks.files import check_outputs, write_trajectory
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import Entry, text, write_log
from tests.replay.command import Command, rows
from tests.replay.edited import images, save


@pytest.mark.parametrize("content", [b"", b"omnid\n" * 1000, bytes(range(256)) * 64])
def test_refuses_a_file_that_is_no_mcap(omnid: Command, tmp_path: Path, scene: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    error = omnid.refused("replay", tmp_path / "log.mcap", "--rig", scene / "rig.toml")
    assert "log.mcap" in error


def test_refuses_a_missing_log(omnid: Command, tmp_path: Path) -> None:
    assert "absent.mcap" in omnid.refused("replay", tmp_path / "absent.mcap")


@pytest.mark.parametrize(
    "words",
    [
        ("replay", "none.mcap"),
        ("replay", "{log}", "--rig", "none.toml"),
        ("calibrate", "height", "none.mcap"),
        ("calibrate", "drive", "none.mcap", "--rig", "{rig}", "-o", "a.toml"),
    ],
)
def test_a_first_start_refuses_a_wrong_path_before_it_compiles(
    tmp_path: Path, scene: Path, words: Sequence[str]
) -> None:
    """A compilation takes a minute on a busy machine."""
    filled = [word.format(log=scene / "log.mcap", rig=scene / "rig.toml") for word in words]
    environment = {**os.environ, "OMNID_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-m", "omnid", *filled], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr


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


def test_refuses_a_log_without_image_topics(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log = write_log(tmp_path / "log.mcap", [Entry("/chatter", "std_msgs/msg/String", text("hello"), 10**18)])
    assert "no image topics" in omnid.refused("replay", log, "--rig", scene / "rig.toml")


@pytest.mark.parametrize("camera", ["lower", "upper"])
def test_refuses_a_log_with_one_camera(omnid: Command, tmp_path: Path, scene: Path, camera: str) -> None:
    log = save(tmp_path / "log.mcap", [p for p in images(scene / "log.mcap") if p.camera == camera])
    missing = {"lower": "upper", "upper": "lower"}[camera]
    assert f"no {missing} camera" in omnid.refused("replay", log, "--rig", scene / "rig.toml")


@pytest.mark.parametrize("masks", [True, False])
def test_refuses_a_rig_of_another_image_size(omnid: Command, tmp_path: Path, scene: Path, masks: bool) -> None:
    rig = (scene / "rig.toml").read_text().replace("size = [256, 256]", "size = [640, 640]")
    (tmp_path / "rig.toml").write_text(rig if masks else without_masks(rig))
    error = omnid.refused("replay", scene / "log.mcap", "--rig", tmp_path / "rig.toml", "--quiet")
    assert "256x256" in error and "640x640" in error


def without_masks(rig: str) -> str:
    tables = rig.split("\n\n")
    return "\n\n".join(table for table in tables if ".mask]" not in table) + "\n"


def test_refuses_a_log_without_a_rig(omnid: Command, scene: Path) -> None:
    assert "omnid calibrate import" in omnid.refused("replay", scene / "log.mcap")


def test_refuses_a_broken_rig(omnid: Command, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "rig.toml").write_text("schema = 1\n[lower]\nmodel = 7\n")
    assert "rig.toml" in omnid.refused("replay", scene / "log.mcap", "--rig", tmp_path / "rig.toml")


@pytest.mark.parametrize(
    ("pattern", "replacement", "reason"),
    [
        (r"fu = -?", "fu = -9000", "share no view between -50.0 and 40.0 degrees of elevation"),
        (r"xi = .*", "xi = 0x" + "f" * 9000, "keys and numbers of at most 400 characters"),
        (r"schema = 1", "a." * 20_000 + "a = 1", "a key of at most 9 parts"),
        (r"size = .*", "size = [32767, 32767]", "at most 67108864 in all"),
    ],
)
def test_refuses_a_rig_that_would_fill_the_memory(
    omnid: Command, tmp_path: Path, scene: Path, pattern: str, replacement: str, reason: str
) -> None:
    """One line and exit code 2."""
    (tmp_path / "rig.toml").write_text(re.sub(pattern, replacement, (scene / "rig.toml").read_text()))
    assert reason in omnid.refused("replay", scene / "log.mcap", "--rig", tmp_path / "rig.toml")


def test_skips_and_counts_broken_jpegs(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    broken = {0: b"", 9: b"no image at all", 20: taken[20].jpeg[: len(taken[20].jpeg) // 2]}
    log = save(tmp_path / "log.mcap", [replace(p, jpeg=broken.get(i, p.jpeg)) for i, p in enumerate(taken)])
    result = omnid.replay(log, "--tum", tmp_path / "est.txt", rig=scene / "rig.toml")
    assert result.code == 0 and result.count("broken") == 3
    assert result.count("unpaired_lower") + result.count("unpaired_upper") == 3
    assert len(rows(tmp_path / "est.txt")) == result.count("pairs") == PAIRS - 3


def test_warns_if_all_jpegs_are_broken(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log = save(tmp_path / "log.mcap", [replace(p, jpeg=b"\xff\xd8\xff?") for p in images(scene / "log.mcap")])
    result = omnid.replay(log, "--tum", tmp_path / "t", "--cloud", tmp_path / "m", rig=scene / "rig.toml")
    assert result.code == 1 and result.count("broken") == 2 * PAIRS and result.count("pairs") == 0
    assert "no pair of images" in result.err


def test_the_order_in_the_log_changes_nothing(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    delays = random.Random(1)
    shuffled = sorted(taken, key=lambda p: p.pair + delays.uniform(0, 5))
    assert [p.stamp_ns for p in shuffled] != sorted(p.stamp_ns for p in shuffled)
    log = save(tmp_path / "log.mcap", shuffled)
    for name, source in (("est.txt", scene / "log.mcap"), ("shuffled.txt", log)):
        assert omnid.replay(source, "--tum", tmp_path / name, rig=scene / "rig.toml").code == 0
    assert (tmp_path / "est.txt").read_bytes() == (tmp_path / "shuffled.txt").read_bytes()


def test_counts_late_and_duplicate_images(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    late, rest = replace(taken[10], written_ns=taken[41].stamp_ns), taken[:10] + taken[11:]
    log = save(tmp_path / "log.mcap", [*rest[:8], rest[7], *rest[8:40], late, *rest[40:]])
    result = omnid.replay(log, "--set", "log.reorder_frames=8", rig=scene / "rig.toml")
    assert result.code == 0 and "warning" in result.err
    assert (result.count("late"), result.count("duplicate"), result.count("pairs")) == (1, 1, PAIRS - 1)


@pytest.mark.parametrize("option", ["--tum", "--cloud", "--plan", "--record"])
def test_refuses_an_unwritable_output_before_the_run(omnid: Command, tmp_path: Path, scene: Path, option: str) -> None:
    kept = tmp_path / "kept.txt"
    kept.write_text("previous result")
    other = "--tum" if option != "--tum" else "--cloud"
    for path, reason in ((tmp_path / "absent" / "x", "no folder"), (tmp_path, "folder"), (Path("/proc/x"), "/proc/x")):
        error = omnid.refused("replay", tmp_path / "absent.mcap", other, kept, option, path)
        assert reason in error and option in error
    assert kept.read_text() == "previous result" and list(tmp_path.iterdir()) == [kept]


def test_a_refused_run_leaves_no_files(omnid: Command, tmp_path: Path, scene: Path) -> None:
    omnid.refused("replay", scene / "log.mcap", "--tum", tmp_path / "fresh", "--record", tmp_path / "absent" / "x")
    assert list(tmp_path.iterdir()) == []


def test_outputs_must_differ_from_each_other_and_from_the_log(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log = scene / "log.mcap"
    before = log.read_bytes()
    assert "the log that is read" in omnid.refused("replay", log, "--record", scene / ".." / scene.name / "log.mcap")
    assert "--tum" in omnid.refused("replay", log, "--tum", tmp_path / "x", "--cloud", tmp_path / "x")
    assert log.read_bytes() == before


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


def test_refuses_impossible_paths(omnid: Command, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in (tmp_path / "loop", tmp_path / ("x" * 300), scene / "rig.toml" / "x", Path("-")):
        omnid.refused("replay", path, "--rig", scene / "rig.toml", "--tum", tmp_path / "x")
        omnid.refused("replay", scene / "log.mcap", "--rig", path, "--tum", tmp_path / "x")
        omnid.refused("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--tum", path)
        omnid.refused("calibrate", "import", scene / "camchain.yaml", "--output", path)
        omnid.refused("eval", path, scene / "truth.txt")
    assert not (tmp_path / "x").exists() and not Path("-").exists()


def test_an_output_through_a_link_keeps_the_link(omnid: Command, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert omnid.replay(scene / "log.mcap", "--tum", tmp_path / "link", rig=scene / "rig.toml").code == 0
    assert (tmp_path / "link").is_symlink() and len(rows(tmp_path / "real")) == PAIRS


def test_does_not_replace_a_device_by_a_map(omnid: Command, scene: Path) -> None:
    assert "device" in omnid.refused("replay", scene / "log.mcap", "--cloud", "/dev/null")
    assert Path("/dev/null").is_char_device()


def test_refuses_a_panorama_that_is_too_small(omnid: Command, scene: Path) -> None:
    words = ("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", "--set", "panorama.width_px=64")
    assert "panorama" in omnid.refused(*words)


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("stereo.matching.methods=sad", "stereo.matching.method"),
        ("stereo.min_range_m=near", "stereo.min_range_m"),
        ("pair.tolerance_ms=-1", "pair.tolerance_ms"),
        ("nonsense", "="),
        ("odometry.method=magic", "'paper'"),
    ],
)
def test_names_a_wrong_setting(omnid: Command, scene: Path, setting: str, named: str) -> None:
    assert named in omnid.refused("replay", scene / "log.mcap", "--set", setting)


def test_refuses_wrong_arguments_in_one_line(omnid: Command) -> None:
    for words in ([], ["fly"], ["replay"], ["replay", "x", "--method", "magic"], ["eval", "a"], ["--what"]):
        omnid.refused(*words)


def test_refuses_a_missing_motor_before_the_run(omnid: Command, tmp_path: Path, scene: Path) -> None:
    error = omnid.refused("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--motor", tmp_path / "tty")
    assert "motor port" in error


def test_other_files_than_a_rig_say_what_to_do_with_them(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log, camchain = scene / "log.mcap", tmp_path / "camchain.yaml"
    camchain.write_text("cam0: {}\n")
    assert f"`omnid calibrate import {camchain} -o rig.toml`" in omnid.refused("replay", log, "--rig", camchain)
    assert "without --rig the one attached to the log is used" in omnid.refused("replay", log, "--rig", log)
    assert "`omnid calibrate import` or" in omnid.refused("replay", log, "--rig", tmp_path / "absent.toml")
    rig = scene / "rig.toml"
    assert f"use it as it is, --rig {rig}" in omnid.refused("calibrate", "import", rig, "-o", tmp_path / "out.toml")


def test_a_log_without_topics_names_the_command_that_examines_it(omnid: Command, tmp_path: Path, scene: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((scene / "log.mcap").read_bytes()[:2000])
    assert "`omnid log info`" in omnid.refused("replay", cut, "--rig", scene / "rig.toml")
