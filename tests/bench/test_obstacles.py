"""The benchmark of worlds like buildings: a short drive with its row in the tables, and stored pairs with the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.bench import obstacles, open_loop
from tests.bench.obstacles import Drive, Planned

NEAR = Planned("near_box_ahead", 1, 0.3, 192, overrides=("controller.collision.check=false",))


def test_a_drive_through_a_near_box_is_a_contact_and_has_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path))
    asked, robot = obstacles.prepared(NEAR)
    monkeypatch.setattr(obstacles, "prepared", lambda planned: (replace(asked, way_m=0.8), robot))
    made = obstacles.drive(NEAR)
    assert made.own == made.contacts >= 1 and made.clearance_m < -0.1
    assert 0.76 < made.driven_m < 1.0 and not made.ended and made.pairs > 25
    obstacles.tables([NEAR], {str(NEAR): made})
    assert f"| near_box_ahead | 1 | {made.contacts} | {made.own} |" in capsys.readouterr().out


def test_the_tables_count_what_is_right() -> None:
    passed = Drive(8.0, 8.0, 20.0, 0, 0, 0.3, None, "", 200, 1.0)
    cases = [(passed, True), (replace(passed, stopped_m=0.4), True), (replace(passed, stopped_m=1.2), False)]
    cases += [(replace(passed, stopped_m=0.01), False), (replace(passed, contacts=1, own=1), False)]
    cases += [(replace(passed, contacts=1), True)]  # somebody walked into a base that stood
    assert [one.is_right for one, _ in cases] == [right for _, right in cases]


def test_stored_pairs_have_the_range_of_the_first_thing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_loop, "LONGEST_M", 0.3)
    path = open_loop.stored(Planned("white_wall", 1, 0.3, 192), tmp_path)
    with np.load(path) as file:
        assert file["lower"].shape == file["upper"].shape == (len(file["stamps_ns"]), 192, 192)
        ahead_m, x_m = file["first_m"][:, 179:181].mean(axis=1), file["T_world_base"][:, 0, 3]
    assert len(x_m) > 3 and ahead_m + x_m == pytest.approx(np.full(len(x_m), ahead_m[0] + x_m[0]), abs=1e-3)
    assert 3.5 <= ahead_m[0] + x_m[0] <= 4.5
    assert open_loop.stored(Planned("white_wall", 1, 0.3, 192), tmp_path) == path


def test_ranges_of_the_scan_are_compared_with_the_truth_by_metre(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path))
    first_m = np.full((3, 360), 1.5)
    first_m[:, :100] = np.inf
    np.savez(tmp_path / "a.npz", scan_m=first_m - 0.04, first_m=first_m, sigma_m=np.full_like(first_m, 0.02))
    open_loop.add_scan_table([tmp_path / "a.npz"])
    assert "| 1 to 2 | 780 | -0.040 | 0.040 | 2.0 |" in capsys.readouterr().out
