"""The parts that runs share: what is said at the start about obstacles that cannot be seen."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from omnid.config import load_config
from omnid.engine.graph import Graph
from omnid.runs.session import Session
from omnid.simulation.rendering.rigs import make_rig
from omnid.simulation.robot import with_masks


def warnings_of(size_px: int, *overrides: str) -> list[str]:
    """Return the warnings of a run that drives, with images of that size."""
    lines: list[str] = []
    with ExitStack() as outputs:
        session = Session(load_config(None, list(overrides)), Graph(threaded=False), outputs, lines.append)
        session.geometry(with_masks(make_rig(size=size_px, baseline_m=0.2)), [])
        session.with_obstacles_known(session.config.controller)
    return lines


def test_small_images_are_named_with_what_to_do() -> None:
    (line,) = warnings_of(320)
    assert "87 rows" in line and "384 px" in line and "controller.collision.unknown" in line


@pytest.mark.parametrize(
    ("size_px", "override"),
    [
        (384, "controller.collision.unknown=stop"),
        (320, "controller.collision.unknown=slow"),
        (320, "controller.collision.check=false"),
    ],
)
def test_no_warning_of_images_that_are_large_enough_or_do_not_matter(size_px: int, override: str) -> None:
    assert warnings_of(size_px, override) == []


def test_a_run_without_obstacles_says_that_nothing_keeps_the_base_from_them() -> None:
    (line,) = warnings_of(320, "obstacles.enabled=false")
    assert "the collision monitor is off" in line
