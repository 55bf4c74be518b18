"""The rendered corridor that several modules look at."""

from __future__ import annotations

import pytest

from tests.omnid.core.scenery import Eyes
from tests.simulation import corridor, make_rig


@pytest.fixture(scope="session")
def cameras() -> Eyes:
    """A straight rig, whose rectified frame is its own, in a corridor."""
    return Eyes.of(make_rig(size=256), corridor(1))
