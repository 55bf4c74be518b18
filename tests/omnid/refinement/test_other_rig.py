"""Scatter of the columns of the first pairs: what is looked at more closely, and what is told as a rig that is off."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.config import Config, PanoramaConfig
from omnid.core.rig.column_finding import RigFinding
from omnid.core.rig.first_pairs import StartFinding, start_finding
from omnid.core.rig.rig_state import RigState
from omnid.core.stereo.photometry import Light
from omnid.messages import FramePair, OdometryUpdate, StereoDepth
from omnid.refinement.other_rig import is_suspicious, other_rig
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry
from omnid.tracking_state import TrackingState


def finding(spread_px: float) -> RigFinding:
    return RigFinding(RigState.UNCHECKED, 200, 320, 0.0, spread_px, (), 0.1, None)


@pytest.mark.parametrize(
    ("spread_px", "state", "suspicious"), [(0.1, "unchecked", False), (0.45, "unchecked", True), (0.7, "drifted", True)]
)
def test_scattered_columns(spread_px: float, state: str, suspicious: bool) -> None:
    found = start_finding(finding(spread_px), 20)
    assert (found.state, is_suspicious(found)) == (state, suspicious)


def test_a_rig_that_is_off_is_suspicious_and_one_that_was_not_seen_is_not() -> None:
    assert is_suspicious(StartFinding(RigState.DRIFTED, finding(0.1), 20)) and not is_suspicious(None)


@pytest.mark.parametrize(
    ("lost", "of", "state", "dark", "is_other"),
    [
        (8, 20, RigState.DRIFTED, False, True),
        (8, 20, RigState.FITS, False, False),
        (8, 20, RigState.DRIFTED, True, False),
        (3, 20, RigState.DRIFTED, False, False),
        (2, 4, RigState.DRIFTED, False, False),
    ],
)
def test_columns_that_do_not_match_and_lost_poses_are_those_of_another_rig(
    lost: int, of: int, state: RigState, dark: bool, is_other: bool
) -> None:
    place, black = geometry(make_rig(size=256), PanoramaConfig()), np.zeros((256, 256), np.uint8)
    panoramas = Dewarp(place, PanoramaConfig()).process(FramePair(0, 0, black, black))
    depth = StereoDepth(panoramas)
    light = Light(5.0, 0.1) if dark else Light(90.0, 20.0)
    states = [TrackingState.LOST] * lost + [TrackingState.DEGRADED] * (of - lost)
    updates = [
        OdometryUpdate(
            number, 10**9 * number, np.eye(4), np.eye(6), np.zeros(6), np.eye(6), tracking, 0, 9, 9, depth, light=light
        )
        for number, tracking in enumerate(states)
    ]
    reason = other_rig(updates, FrontEnd(place, Config()), StartFinding(state, finding(1.0), 20))
    expected = f"no pose is found for {lost} of the first {of} pairs"
    assert reason.startswith(expected) if is_other else not reason
