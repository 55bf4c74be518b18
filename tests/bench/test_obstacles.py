"""The benchmark of worlds like buildings: a short drive with its row in the tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.bench import obstacles
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
    assert 0.76 < made.driven_m < 1.0 and not made.ended
    obstacles.tables([NEAR], {str(NEAR): made})
    assert f"| near_box_ahead | 1 | {made.contacts} | {made.own} |" in capsys.readouterr().out


def test_the_tables_count_what_is_right() -> None:
    passed = Drive(8.0, 8.0, 20.0, 0, 0, 0.3, None, "")
    cases = [(passed, True), (replace(passed, stopped_m=0.4), True), (replace(passed, stopped_m=1.2), False)]
    cases += [(replace(passed, stopped_m=0.01), False), (replace(passed, contacts=1, own=1), False)]
    cases += [(replace(passed, contacts=1), True)]  # somebody walked into a base that stood
    assert [one.is_right for one, _ in cases] == [right for _, right in cases]
