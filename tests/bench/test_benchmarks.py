"""Benchmarks can be imported; tables and claims of the paper on small drives and logs; the soak test of the daemon."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.bench import obstacles
from tests.bench.daemon import daemon, status
from tests.bench.obstacles import Drive, Planned
from tests.bench.paper import measures
from tests.bench.paper.scenes import Experiment

ROOT = Path(__file__).parents[2]


def test_each_module_can_be_imported() -> None:
    """In a process of its own: some set what all of a process share."""
    files = list((ROOT / "tests" / "bench").rglob("*.py"))
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files if not file.stem.startswith("_")]
    assert len(names) > 15
    program = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"
    done = subprocess.run([sys.executable, "-c", program, *names], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr.splitlines()[-1]


SOAK_S = 60 * float(os.environ.get("OMNID_SOAK_MINUTES", "2"))
PERIOD_S = 5.0  # between two samples
GROWTH_KB = 8 * 1024  # allowed growth from the first half to the second: noise of the allocator


@pytest.mark.slow
def test_memory_descriptors_and_threads_do_not_grow(tmp_path: Path) -> None:
    """Run 30 pairs a second with commands, maps and status reports on the bus."""
    with daemon(tmp_path, 3.0) as (process, _, base):
        time.sleep(20)  # until caches, pools and the map of the repeated scene are full
        pid, sizes = process.process.pid, []
        deadline_s = time.monotonic() + SOAK_S
        while time.monotonic() < deadline_s:
            time.sleep(PERIOD_S)
            assert process.alive
            found = status(pid)
            sizes.append((found["VmRSS"], len(os.listdir(f"/proc/{pid}/fd")), found["Threads"]))
        drives = base.drives
    half = len(sizes) // 2
    (before_kb, *before), (after_kb, *after) = (
        map(max, zip(*part, strict=True)) for part in (sizes[:half], sizes[half:])
    )
    assert drives and after_kb <= before_kb + GROWTH_KB
    assert after <= before


NEAR = Planned("near_box_ahead", 1, 0.3, 192, overrides=("controller.collision.check=false",))


def test_a_drive_through_a_near_box_is_a_contact_and_has_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path))
    asked, robot = obstacles.prepared(NEAR)
    monkeypatch.setattr(obstacles, "prepared", lambda planned: (replace(asked, way_m=0.8), robot))
    made = obstacles.drive(NEAR)
    assert made.own == made.contacts >= 1 and made.clearance_m < -0.1
    assert 0.76 < made.driven_m < 1.0 and not made.ended
    obstacles.tables([NEAR], {str(NEAR): made})
    assert f"| near_box_ahead | 1 | {made.contacts} | {made.own} |" in capsys.readouterr().out


def test_the_tables_count_what_is_right() -> None:
    passed = Drive(8.0, 8.0, 20.0, 0, 0, 0.3, None, "")
    cases = [(passed, True), (replace(passed, stopped_m=0.4), True), (replace(passed, stopped_m=1.2), False)]
    cases += [(replace(passed, stopped_m=0.01), False), (replace(passed, contacts=1, own=1), False)]
    cases += [(replace(passed, contacts=1), True)]  # somebody walked into a base that stood
    assert [one.is_right for one, _ in cases] == [right for _, right in cases]


# Rendered by POV-Ray, another renderer than omnid's: brick --seed 1 --size 512 --pairs 1, turns --size 448 --pairs 5.
SMALL = Path(__file__).parent / "paper" / "small"


def test_enhanced_sad_has_at_most_a_third_of_the_wrong_matches_on_bricks() -> None:
    found = measures.walls(SMALL / "brick_s1", Experiment.read(SMALL / "brick_s1"))
    original, enhanced, omnid = (found[name] for name in measures.SAD_METHODS)
    assert original.wrong > 10
    assert enhanced.wrong < original.wrong / 3 and omnid.wrong < original.wrong / 3
    assert enhanced.completeness > max(80, original.completeness)
    assert enhanced.coverage > original.coverage
    assert enhanced.rms_mm < 30


def test_searches_keep_features_through_turns_where_plain_klt_loses_them() -> None:
    found = {turn.angle_deg: turn for turn in measures.turns(SMALL / "turns_s1", Experiment.read(SMALL / "turns_s1"))}
    for sign in (1, -1):
        angles_deg = [0.0, *(sign * angle for angle in (9.0, 18.0, 27.0))]
        plain, *searches = ([found[angle].right[name] for angle in angles_deg] for name in measures.TRACKERS)
        assert plain[3] < 0.7 * plain[0]
        for right in searches:
            assert min(right) > 0.85 * right[1] and right[1] > 0.8 * found[angles_deg[1]].features


@pytest.mark.parametrize("method", [measures.THE_PAPER, measures.OMNID])
def test_a_path_is_compared_with_the_truth(method: str) -> None:
    """The rig of the log of the turns stays in place and turns."""
    _, ate_mm, _, heading_deg = measures.path(SMALL / "turns_s1", method)
    assert isinstance(ate_mm, float) and ate_mm < 10 and isinstance(heading_deg, float) and heading_deg < 0.3
