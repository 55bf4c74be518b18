"""`omnid map show|export`: what is printed and written, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from omnid.cli import main
from omnid.formats.place_file import write_places
from tests.omnid.formats.place_maps import RIG, some_places
from tests.ply import read_ply


@pytest.fixture
def omap(tmp_path: Path) -> Path:
    """Write a map of 12 keyframes."""
    write_places(tmp_path / "a.omap", some_places(12, features=20), RIG)
    return tmp_path / "a.omap"


def test_show_prints_the_sizes(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "show", str(omap)]) == 0
    printed = capsys.readouterr().out
    for text in (
        "sessions     2",
        "keyframes    12, with 240 features; 3 were dropped",
        "loops        1",
        "path         3.3 m",
        "rig          0123abcd0123, baseline 0.2400 m, panoramas of 1304 x 378 px",
    ):
        assert text in printed


def test_export_writes_the_files_and_names_them(omap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = {end: omap.parent / f"a.{end}" for end in ("ply", "png", "yaml", "pgm")}
    words = ["--ply", str(a["ply"]), "--plan", str(a["png"]), "--grid", str(a["yaml"]), "--cell", "0.1"]
    assert main(["map", "export", str(omap), *words]) == 0
    printed = capsys.readouterr().out
    assert all(str(path) in printed for path in a.values())
    assert len(read_ply(a["ply"]).xyz) > 50 and a["pgm"].read_bytes().startswith(b"P5\n")
    assert "resolution: 0.1\n" in a["yaml"].read_text() and "image: a.pgm\n" in a["yaml"].read_text()
    # The loop is a line of its own colour in the plan.
    plan = cv2.imread(str(a["png"])).astype(int)
    assert np.count_nonzero(plan[..., 0] > plan[..., 2] + 100) > 20


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export", "{}"], "nothing to write"),
        (["export", "{}", "--grid", "{}.png"], "expected a name that ends in .yaml"),
        (["export", "{}", "--grid", "."], "--grid .: expected a file to write, found a folder"),
        (["export", "{}", "--ply", "{}"], "this is the map that is read as well"),
        (["show", "{}.none"], "cannot read the map"),
    ],
)
def test_mistakes_are_one_line(omap: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = omap.read_bytes()
    try:
        code = main(["map", *(word.format(omap) for word in words)])
    except SystemExit as ended:
        code = int(str(ended.code))
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1
    assert omap.read_bytes() == before and [path.name for path in omap.parent.iterdir()] == ["a.omap"]
