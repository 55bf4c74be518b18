"""AprilTags of a log as landmarks: their poses in the map, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from omnid.formats.landmark_file import read_landmarks
from omnid.simulation.rendering.surfaces import Rectangle
from tests.replay.command import Command
from tests.simulation import Scene, build, write_log

EDGE_M, QUIET_M = 0.6, 0.15  # of the black square, and the white border around it
AT_START = np.array([0.9, 0.9, 0.1])  # m: the tag's middle in the rig frame of the first pair; it faces the rig's y


@pytest.fixture(scope="module")
def tagged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short drive past a tag."""
    folder = tmp_path_factory.mktemp("tagged")
    run = build("two_walls", seed=3, size=384, pairs=5)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    square = cv2.aruco.generateImageMarker(family, 5, 320)
    image = cv2.copyMakeBorder(square, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    T, half = run.poses[0], EDGE_M / 2 + QUIET_M
    # On a wall to the left, what is to the right lies ahead.
    corner = T[:3, :3] @ (AT_START + np.array([-half, 0, half])) + T[:3, 3]
    tag = Rectangle(corner, T[:3, :3] @ [2 * half, 0, 0], T[:3, :3] @ [0, 0, -2 * half], image, "tag")
    write_log(folder, run.rig, run.poses, Scene((*run.scene.rectangles, tag)), sensor=run.sensor, seed=3)
    return folder


def test_a_tag_is_located_in_the_map(omnid: Command, tagged: Path, tmp_path: Path) -> None:
    code, out, err = omnid(
        "map",
        "tags",
        tagged / "log.mcap",
        "--rig",
        tagged / "rig.toml",
        "--tag",
        f"5={EDGE_M}",
        "--tag",
        "6=0.2",
        "--json",
        "--write",
        tmp_path / "tags.toml",
    )
    assert code == 1 and "not found, or in several places: 6;" in err
    [found] = json.loads(out)["tags"]
    assert found["id"] == 5 and found["views"] >= 2 and found["rejected"] == 0
    error = np.linalg.norm(np.array(found["xyz_m"]) - AT_START)
    assert error < 0.02 and error < 5 * found["sigma_m"]
    # The rig sees it from the side that it faces: it hangs to the left.
    [mark] = read_landmarks(tmp_path / "tags.toml").values()
    np.testing.assert_allclose(mark.xyz_m, found["xyz_m"], atol=1e-4)
    assert mark.size_m == EDGE_M and mark.facing_rad is not None and abs(mark.facing_rad + np.pi / 2) < 0.1


TAGS = f'schema = 1\n[tag."door 5"]\nid = 5\nsize_m = {EDGE_M}\n'


def test_a_map_keeps_its_tags_and_is_aligned_by_them(omnid: Command, tagged: Path, tmp_path: Path) -> None:
    (tmp_path / "tags.toml").write_text(TAGS)
    omap, rig = tmp_path / "a.omap", tagged / "rig.toml"
    code, out, err = omnid(
        "map", "build", tagged / "log.mcap", "-o", omap, "--rig", rig, "--tags", tmp_path / "tags.toml", "--quiet"
    )
    assert code == 0 and "tags         1, of which 1 were seen" in out and err.count("\n") == 1, err  # of the height
    code, out, _ = omnid("map", "tags", omap, "--json")
    [found] = json.loads(out)["tags"]
    assert code == 0 and found["id"] == 5 and found["name"] == "door 5" and found["views"] >= 2
    assert np.linalg.norm(np.array(found["xyz_m"]) - AT_START) < 0.02
    assert "door 5" in omnid("map", "tags", omap).out
    # On the plan it hangs at (7, 8) and faces x.
    (tmp_path / "plan.toml").write_text(TAGS + "xyz_m = [7, 8, 1]\nfacing_deg = 0\n")
    aligned = tmp_path / "b.omap"
    assert omnid("map", "align", omap, "--known", tmp_path / "plan.toml", "-o", aligned).code == 0
    [moved] = json.loads(omnid("map", "tags", aligned, "--json").out)["tags"]
    np.testing.assert_allclose(moved["xyz_m"], [7, 8, 1], atol=1e-6)
    # A run in the map knows its tags, and refuses another size.
    result = omnid.replay(tagged / "log.mcap", "--map", omap, "--localize-only", rig=rig)
    assert result.code == 0 and result.count("tags_seen") == 1
    (tmp_path / "tags.toml").write_text(TAGS.replace(f"= {EDGE_M}", "= 0.5"))
    error = omnid.refused(
        "replay", tagged / "log.mcap", "--rig", rig, "--quiet", "--map", omap, "--tags", tmp_path / "tags.toml"
    )
    assert "tag 5 (door 5) has an edge of 0.5 m, but 0.6 m in the map" in error
    assert "belong to a log" in omnid.refused("map", "tags", omap, "--tag", "5=0.6")
    assert "expected --tag ID=SIZE" in omnid.refused("map", "tags", tagged / "log.mcap")
    tags = tmp_path / "tags.toml"
    error = omnid.refused("map", "tags", tagged / "log.mcap", "--rig", rig, "--tags", tags, "--write", tags)
    assert "--write" in error and tags.read_text().startswith(TAGS[:20])


def test_wrong_sizes_are_one_line(omnid: Command, tagged: Path) -> None:
    for word, message in (
        ("5", "expected ID=SIZE"),
        ("5=x", "expected ID=SIZE"),
        ("900=0.2", "0 to 586"),
        ("5=0", "0.005 to 10 m"),
        ("5=nan", "0.005 to 10 m"),
    ):
        error = omnid.refused("map", "tags", tagged / "log.mcap", "--rig", tagged / "rig.toml", "--tag", word)
        assert message in error
