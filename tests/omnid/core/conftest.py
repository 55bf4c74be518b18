"""The rendered corridor that several modules share."""

from __future__ import annotations

import pytest

from tests.omnid.core.scenery import RenderedCameras
from tests.simulation import corridor, make_rig


@pytest.fixture(scope="session")
def cameras() -> RenderedCameras:
    """A straight rig, whose rectified frame is its own, in a corridor."""
    return RenderedCameras.of(make_rig(size=256), corridor(1))
