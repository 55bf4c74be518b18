"""A rig in a rendered room, and poses of its drive: it has points in all directions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.omnid.core.scenery import RenderedCameras
from tests.simulation import build


@pytest.fixture(scope="session")
def room() -> tuple[RenderedCameras, NDArray[np.float64]]:
    """The cameras, and poses T_world_rig (N, 4, 4) of a loop."""
    run = build("rooms", seed=31, size=256, pairs=24)
    return RenderedCameras.of(run.rig, run.scene), np.asarray(run.poses)
