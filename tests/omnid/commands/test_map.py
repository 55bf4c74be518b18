"""`omnid map info|export`: what is printed and written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from omnid.cli import main
from omnid.core.places.map_tags import MapTag
from omnid.core.places.place_views import base_poses
from omnid.formats.place_file import read_places, write_places
from tests.omnid.formats.place_maps import RIG, some_places
from tests.ply import read_ply


@pytest.fixture
def omap(tmp_path: Path) -> Path:
    """Write a map of 12 keyframes."""
    write_places(tmp_path / "a.omap", some_places(12, features=20), RIG)
    return tmp_path / "a.omap"


def test_info_tells_the_sizes(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(omap)]) == 0
    printed = capsys.readouterr().out
    for text in (
        "sessions     2",
        "keyframes    12, with 240 features; 3 were dropped",
        "loops        1",
        "path         3.3 m",
        "rig          0123abcd0123, baseline 0.2400 m, panoramas of 1304 x 378 px",
    ):
        assert text in printed


def test_info_as_json_and_of_a_file_that_is_no_map(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (omap.parent / "b.omap").write_bytes(b"no map")
    assert main(["map", "info", "--json", str(omap), str(omap.parent / "b.omap")]) == 2
    printed = capsys.readouterr()
    [found] = json.loads(printed.out)
    assert (found["keyframes"], found["sessions"], found["loops"], found["parts"]) == (12, 2, 1, 1)
    assert printed.err.count("\n") == 1 and "expected a map of places" in printed.err


def test_show_writes_a_page_with_keyframes_loops_and_both_paths(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is one file, and nothing in it comes from elsewhere."""
    page = omap.parent / "a.html"
    assert main(["map", "show", str(omap), "-o", str(page)]) == 0
    printed = capsys.readouterr()
    assert not printed.err and printed.out.split() == ["written", str(page)]
    assert "white is" not in page.read_text("utf-8"), "wrong on a dark screen"
    html = page.read_text()
    assert html.count("class='keyframe'") == 12 and html.count("<title>0 to 11: 77 features</title>") == 1
    assert html.count("<path class='after'") == html.count("<path class='before'") == 3  # two sessions, and the keys
    for text in ("session 0, keyframes 0 to 9", "session 1, keyframes 10 to 11", "12, with 240 features", "a.omap"):
        assert text in html
    assert "http" not in html.replace("http-equiv", "")
    assert main(["map", "show", str(omap), "-o", str(omap)]) == 2 and capsys.readouterr().err.count("\n") == 1


SEEN = "schema = 1\n[tag.5]\nid = 5\nsize_m = 0.2\nxyz_m = [1, 2, 0.5]\nfacing_deg = 0\n"


def test_align_moves_a_map_into_the_axes_of_a_plan(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is turned by 90 degrees; a plan that does not fit, or does not tell, is refused."""
    seen, plan, out = (omap.parent / name for name in ("seen.toml", "plan.toml", "out.omap"))
    words = ["map", "align", str(omap), "--seen", str(seen), "--known", str(plan), "-o", str(out)]
    seen.write_text(SEEN)
    plan.write_text(SEEN.replace("tag.5", "tag.dock").replace("[1, 2,", "[11, 2,").replace("= 0\n", "= 90\n"))
    assert main(words) == 0 and "tag 5 (dock): 0 mm from its place on the plan" in capsys.readouterr().out
    assert main(words) == 2 and f"map align: {out} exists: --replace makes a new one" in capsys.readouterr().err
    words.append("--replace")
    before, after = (base_poses(*read_places(path)) for path in (omap, out))
    np.testing.assert_allclose(after[:, 0, 3], 11 - (before[:, 1, 3] - 2), atol=1e-9)
    np.testing.assert_allclose(after[:, 1, 3], 2 + before[:, 0, 3] - 1, atol=1e-9)
    two = SEEN + SEEN[11:].replace("5", "6").replace("[1, 2,", "[4, 2,")
    for text, message in (
        (SEEN.replace("facing_deg = 0\n", ""), "1 tags in common: two landmarks"),
        (two, "from its place on the plan"),
    ):
        seen.write_text(text)
        plan.write_text(text.replace("[4, 2,", "[6, 2,"))
        assert main(words) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1


def test_align_may_write_the_map_that_it_reads(omap: Path) -> None:
    plan = omap.parent / "plan.toml"
    plan.write_text(SEEN)
    assert main(["map", "align", str(omap), "--seen", str(plan), "--known", str(plan), "-o", str(omap)]) == 0


def test_merge_replaces_no_other_map_and_joins_none_with_itself(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other, taken, link = (omap.parent / name for name in ("b.omap", "taken.omap", "link.omap"))
    write_places(other, some_places(12, features=20), RIG)
    taken.write_bytes(b"of another building")
    link.symlink_to(omap)
    for maps, message in (
        ((omap, other), f"map merge: {taken} exists: --replace makes a new one"),
        ((omap, other, link), f"map merge: expected maps of several drives, found {link} twice"),
    ):
        assert main(["map", "merge", *map(str, maps), "-o", str(taken)]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert taken.read_bytes() == b"of another building"


def test_merge_refuses_maps_in_which_a_tag_has_other_sizes(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places, other = some_places(12, features=20), omap.parent / "b.omap"
    places.tags.known[5] = MapTag(5, "dock", 0.2)
    write_places(other, places, RIG)
    assert main(["map", "merge", str(omap), str(other), "-o", str(omap.parent / "c.omap")]) == 2
    error = capsys.readouterr().err
    assert f"map merge: {other}: tag 5 (dock) has an edge of 0.2 m, but of 0.16 m before: measure it" in error
    assert error.count("\n") == 1 and not (omap.parent / "c.omap").exists()


def test_align_refuses_tags_one_above_the_other(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tag = SEEN.replace("facing_deg = 0\n", "")
    (omap.parent / "tags.toml").write_text(tag + tag[11:].replace("5]", "6]", 1).replace("id = 5", "id = 6"))
    words = ["--seen", str(omap.parent / "tags.toml"), "--known", str(omap.parent / "tags.toml")]
    assert main(["map", "align", str(omap), *words, "-o", str(omap.parent / "b.omap")]) == 2
    error = capsys.readouterr().err
    assert "2 tags in common: across the floor they spread by 0.00 m" in error and error.count("\n") == 1


def test_export_writes_what_is_asked_for_and_names_it(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = omap.parent
    assert (
        main(
            [
                "map",
                "export",
                str(omap),
                "--ply",
                str(out / "a.ply"),
                "--plan",
                str(out / "a.png"),
                "--grid",
                str(out / "a.yaml"),
                "--cell",
                "0.1",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert printed.startswith("written") and all(f"{out}/a.{end}" in printed for end in ("ply", "png", "yaml", "pgm"))
    assert len(read_ply(out / "a.ply").xyz) > 50
    assert cv2.imread(str(out / "a.png")) is not None
    assert "resolution: 0.1\n" in (out / "a.yaml").read_text() and (out / "a.pgm").read_bytes().startswith(b"P5\n")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "nothing to write"),
        (["--grid", "{}/a.png"], "expected a name that ends in .yaml"),
        (["--grid", "."], "--grid .: expected a file to write, found a folder"),
        (["--ply", "{}/a.omap"], "this is the map that is read as well"),
        (["--ply", "{}/none/a.ply"], "there is no folder"),
        (["--ply", "{}/a.ply", "--cell", "0"], "expected an edge of 0.005 to 10 m"),
    ],
)
def test_mistakes_are_one_line(
    omap: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = omap.read_bytes()
    assert main(["map", "export", str(omap), *(option.format(omap.parent) for option in options)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert omap.read_bytes() == before
