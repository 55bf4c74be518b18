"""The rig's entry of the status: its state with advice, and what the refinement has found."""

from __future__ import annotations

import pytest

from calib.panorama import fit_cylinder
from omnid.core.rig.rig_health import RigHealth
from omnid.core.rig.rig_state import RigState
from omnid.diagnostics.rig_status import ADVICE, LEVELS, RefinementReport, rig_status
from omnid.simulation.rendering.rigs import make_rig
from omnid.transport.codec import ERROR, OK, WARN


@pytest.fixture
def health() -> RigHealth:
    return RigHealth(fit_cylinder(make_rig(size=256)), "warn", 5.0)


def test_a_rig_that_was_not_checked_says_what_to_do(health: RigHealth) -> None:
    status = rig_status(health, None)
    assert status.level == OK and status.message.startswith("not checked yet: the robot must drive")
    assert status.values == {"state": "unchecked", "new_views": "0", "needed_views": "16"}


def test_a_graver_refinement_has_the_message(health: RigHealth) -> None:
    status = rig_status(health, RefinementReport(WARN, "moved", {"windows": "2"}), "a.toml")
    assert (status.level, status.message) == (WARN, "moved")
    assert (status.values["windows"], status.values["refined_in_use"]) == ("2", "a.toml")
    assert rig_status(health, RefinementReport(OK, "fits", {})).message.startswith("not checked yet")


def test_each_state_has_a_level_and_advice() -> None:
    assert LEVELS.keys() == ADVICE.keys() == set(RigState)
    assert {state for state, level in LEVELS.items() if level == ERROR} == {s for s in RigState if s.is_contradicted}
