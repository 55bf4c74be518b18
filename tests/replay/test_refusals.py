"""What a replay refuses in one line, and how it goes on with bad input."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import Entry, pairs, text, write_folders, write_log
from tests.replay.command import Command, rows
from tests.replay.edited import images, save

# Words of a command -> a part of the line; {log}, {rig} are right ones, other files are those of `folder`.
TABLE = (
    # Files that are no logs, or logs that cannot be used.
    ("replay {folder}/absent.mcap --rig {rig}", "absent.mcap"),
    ("replay {folder}/chatter.mcap --rig {rig}", "no image topics"),
    ("replay {folder}/cut.mcap --rig {rig}", "`omnid log info`"),
    # Rigs.
    ("replay {log}", "omnid calibrate import"),
    ("replay {log} --rig {folder}/broken.toml", "broken.toml"),
    ("replay {log} --rig {folder}/deep.toml", "expected at most 10000 lines of 256 dots, found 1 of up to 100000 dots"),
    ("replay {log} --rig {folder}/bare.toml", "images are 256x256"),
    ("replay {log} --rig {folder}/narrow.toml", "share no view between -50.0 and 40.0 degrees of elevation"),
    ("replay {log} --rig {folder}/point.toml", "rig: a camera does not see the horizon, or as a point"),
    ("replay {log} --rig {folder}/huge.toml", "at most 67108864 in all"),
    ("replay {log} --rig {log}", "expected TOML in UTF-8"),
    ("replay {log} --rig {folder}/absent.toml", "`omnid calibrate import` or"),
    ("calibrate import {rig} -o {folder}/x", "expected two cameras (cam0, cam1) as Kalibr writes them"),
    # Outputs.
    ("replay {log} --tum {folder}/x --record {folder}/absent/x", "no folder"),
    ("replay {log} --tum {folder}/x --cloud {folder}/x", "--tum"),
    ("replay {log} --record {log}", "the log that is read"),
    # Settings and words.
    ("replay {log} --set nonsense", "expected section.key=value"),
    ("replay {log} --set odometry.method=magic", "'paper'"),
    ("replay {log} --seconds 0", "--seconds: expected 0.001 or more, found '0'"),
    ("replay {log} --rig {rig} --map {log}", "found another file or a damaged one: File is not a zip file"),
    ("replay {log} --rig {rig} --set motor.port={folder}/tty", "does not use motor.port"),
    ("eval {rig}", "the following arguments are required"),
    ("run --once", "add --log"),
    ("run --log {log}", "no rig.toml is attached"),
    ("run --log {log} --rig {rig} --motor {folder}/tty --set motor.watchdog_ms=100", "watchdog_ms"),
    ('run --log {log} --rig {rig} --motor {folder}/tty --set motor.protocol="can"', "protocol"),
    ("simulate room --size 10", "--size: expected 64 to 2048, found '10'"),
    ("record --rig {rig} --lower /dev/no-camera --upper /dev/null", "/dev/no-camera"),
    ("goto 1", "expected X Y [YAW]"),
    ("route teach a/b", "a/b"),
)


@pytest.fixture(scope="module")
def folder(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that are refused."""
    made = tmp_path_factory.mktemp("wrong")
    write_log(made / "chatter.mcap", [Entry("/chatter", "std_msgs/msg/String", text("hello"), 10**18)])
    (made / "cut.mcap").write_bytes((scene / "log.mcap").read_bytes()[:2000])
    rig = (scene / "rig.toml").read_text()
    other = rig.replace("size = [256, 256]", "size = [640, 640]")
    rigs = {
        "broken": "schema = 1\n[lower]\nmodel = 7\n",
        "deep": f"{'a.' * 100_000}b = 1",
        "bare": "\n\n".join(table for table in other.split("\n\n") if ".mask]" not in table) + "\n",
        "narrow": re.sub(r"fu = -?", "fu = -9000", rig),
        "point": re.sub(r"xi = .*", "xi = 32767.0", rig),
        "huge": re.sub(r"size = .*", "size = [32767, 32767]", rig),
    }
    for name, content in rigs.items():
        (made / f"{name}.toml").write_text(content)
    return made


@pytest.mark.parametrize(("words", "part"), TABLE, ids=[f"{words[:50]}-{part[:20]}" for words, part in TABLE])
def test_a_wrong_input_is_refused_in_one_line(omnid: Command, scene: Path, folder: Path, words: str, part: str) -> None:
    names = {"log": scene / "log.mcap", "rig": scene / "rig.toml", "truth": scene / "truth.txt", "folder": folder}
    before = sorted(folder.iterdir())
    assert part.format(**names) in omnid.refused(*words.format(**names).split())
    assert sorted(folder.iterdir()) == before and not Path("-").exists()


def test_the_readable_part_of_a_truncated_log_is_used(omnid: Command, tmp_path: Path, scene: Path) -> None:
    log, tum = save(tmp_path / "log.mcap", images(scene / "log.mcap")), tmp_path / "est.txt"
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) * 6 // 10])
    code, out, err = result = omnid.replay(log, "--tum", tum, rig=scene / "rig.toml")
    assert code == 0 and err.startswith("omnid: warning: ") and "cut" in err, out
    assert PAIRS // 3 < result.count("pairs") < PAIRS
    assert len(rows(tum)) == result.count("pairs")


def test_no_command_overwrites_its_inputs(omnid: Command, tmp_path: Path, scene: Path) -> None:
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
    assert "the log that is read" in omnid.refused("report", bag, "--output", bag / "bag_0.mcap")
    lists = write_folders(tmp_path / "images", pairs(1)) / "times.txt"
    lists.touch()
    for path in (lists, *lists.parent.glob("*/*.jpg")):
        error = omnid.refused("replay", lists.parent, "--rig", rig, "--quiet", "--tum", path)
        assert "the log that is read" in error
    assert {path: path.read_bytes() for path in before} == before


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
