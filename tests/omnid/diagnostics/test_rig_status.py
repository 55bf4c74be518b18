"""The rig's entry of the status: a rig that was not checked."""

from __future__ import annotations

import pytest

from calib.panorama import fit_cylinder
from omnid.core.rig.rig_health import RigHealth
from omnid.diagnostics.part_status import rig_status
from omnid.simulation.rendering.rigs import make_rig
from omnid.transport.codec import OK


@pytest.fixture
def health() -> RigHealth:
    return RigHealth(fit_cylinder(make_rig(size=256)), "warn", 5.0)


def test_a_rig_that_was_not_checked_says_what_to_do(health: RigHealth) -> None:
    status = rig_status(health)
    assert status.level == OK and status.message.startswith("not checked yet: the robot must drive")
    assert status.values == {"state": "unchecked", "new_views": "0", "needed_views": "16"}
