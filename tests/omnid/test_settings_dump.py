"""A dump has every knob and reads back as the same object."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.settings import load
from omnid.settings_dump import dump, dump_minimal
from tests.omnid.sample_settings import Config, written


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["stereo.window_px=31", "stereo.subpixel=false", "motor.serial.port=a\\b", "topics=['a', \"it's\"]"],
        ["motor.serial.bauds=[]", "stereo.horizon_s=2", "offset_m=[1, -2.5e-300, 3]"],
    ],
)
def test_a_dump_reads_back_as_the_same_object(tmp_path: Path, overrides: list[str]) -> None:
    settings = load(Config, None, overrides)
    assert load(Config, written(tmp_path, dump(settings))) == settings


def test_dumps_every_knob_with_its_range_and_its_default() -> None:
    text = dump(load(Config, None, ["stereo.window_px=5"]))
    lines = "# side of the matching window, px\n# an integer from 3 to 31; default 11\nwindow_px = 5\n"
    assert f"[stereo]\n{lines}" in text
    assert "# a list of 3 numbers; default [0.0, 1e-05, 1e+16]\n" in text
    assert "# a string, one of 'sad', 'census'; default \"sad\"\n" in text
    assert "# a number of at most 0; default -1.0\n" in text  # the default of this section here, not of its class
    assert "# a list of integers of at least 1; default [57600]\n" in text


def test_a_minimal_dump_has_what_differs_and_what_is_to_be_shown() -> None:
    settings = load(Config, None, ["stereo.window_px=5"])
    changed = "[stereo]\n# side of the matching window, px\nwindow_px = 5\n"
    assert dump_minimal(settings, ()) == changed
    shown = dump_minimal(settings, ("robot", "stereo.subpixel"))
    assert shown.startswith("# name on the bus\n") or '# robot = "robot"\n' in shown
    assert "# whether to refine\n# subpixel = true\n" in shown and "window_px = 5\n" in shown
