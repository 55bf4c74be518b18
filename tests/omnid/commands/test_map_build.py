"""`omnid map build --jobs`: maps of the logs side by side, joined where they share a place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.formats.place_file import read_places
from tests.replay.command import Command


def test_maps_built_side_by_side_are_joined_in_the_frame_of_the_first_log(
    omnid: Command, scene: Path, tmp_path: Path
) -> None:
    """Three drives of one place: a pair is joined, then the third one."""
    words = ("map", "build", *[scene / "log.mcap"] * 3, "--rig", scene / "rig.toml", "-o", tmp_path / "m.omap")
    done = omnid(*words, "--jobs", 2)
    assert done.code == 0 and "sessions     3" in done.out, done
    assert "1 + 1 logs" in done.err and "2 + 1 logs" in done.err and "height of the cameras" in done.err
    places, _ = read_places(tmp_path / "m.omap")
    each = len(places) // 3
    assert len(places) == 3 * each
    for n in range(3):
        np.testing.assert_allclose(places.poses[n * each], places.poses[0], atol=0.005)
    assert [path.name for path in tmp_path.iterdir()] == ["m.omap"]


def test_a_map_is_extended_by_logs_side_by_side(omnid: Command, scene: Path, tmp_path: Path) -> None:
    words = ("map", "build", scene / "log.mcap", "--rig", scene / "rig.toml", "-o", tmp_path / "m.omap", "--quiet")
    assert omnid(*words).code == 0
    before = (tmp_path / "m.omap").read_bytes()
    assert "--extend adds these logs" in omnid.refused(*words) and (tmp_path / "m.omap").read_bytes() == before
    done = omnid(*words, "--extend", "--jobs", 2)
    assert done.code == 0 and "sessions     2" in done.out, done


def test_a_log_of_another_place_or_without_a_map_is_named_and_nothing_is_written(
    omnid: Command, scene: Path, elsewhere: Path, tmp_path: Path
) -> None:
    build = ("map", "build", scene / "log.mcap", "--rig", scene / "rig.toml", "-o", tmp_path / "m.omap", "--quiet")
    done = omnid(*build[:3], elsewhere / "log.mcap", *build[3:], "--jobs", 2)
    error = done.err.splitlines()[-1]
    assert done.code == 2 and error.startswith(f"omnid: map build: {elsewhere / 'log.mcap'}: shares no place"), done
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    error = omnid.refused(*build[:2], tmp_path / "broken.mcap", *build[3:], "--jobs", 2)
    assert error.count("broken.mcap") == 1
    assert "expected 1 to" in omnid.refused(*build, "--jobs", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["broken.mcap"]
