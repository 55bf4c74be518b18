"""The state of a rig by points whose columns are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.core.rig.column_finding import MIN_CONTRAST_POINTS, MIN_MATCHES, SECTORS, judge
from omnid.core.rig.column_matches import Matches
from omnid.core.rig.rig_state import RigState
from omnid.core.stereo.triangulation import view
from tests.omnid.core.scenery import RenderedCameras

BASELINE_M = 0.2


def matches(cylinder: Cylinder, turn_deg: tuple[float, float, float], count: int = 5 * MIN_MATCHES) -> Matches:
    """Return views of points all around, of a rig whose upper camera is turned about x, y and z."""
    rng = np.random.default_rng(5)
    azimuth, range_m = rng.uniform(-np.pi, np.pi, count), rng.uniform(1.0, 6.0, count)
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(-0.3, 0.5, count)])
    T_upper = se3.transform(se3.rotation_exp(np.deg2rad(turn_deg)), [0.0, 0.0, BASELINE_M])
    lower = view(points, cylinder, BASELINE_M)[:, :2]
    upper = view(se3.apply(se3.inverse(T_upper), points), cylinder, BASELINE_M)[:, :2]
    noise = rng.normal(0.0, 0.02, lower.shape)
    return Matches(lower, upper + noise, count, count)


@pytest.mark.parametrize(
    ("turn_deg", "state"),
    [
        ((0.0, 0.0, 0.0), RigState.FITS),
        ((0.0, 0.0, 0.5), RigState.DRIFTED),
        ((0.4, -0.4, 0.0), RigState.DRIFTED),
        ((0.0, 0.0, 3.0), RigState.BROKEN),
    ],
)
def test_the_state_follows_the_turn(
    cameras: RenderedCameras, turn_deg: tuple[float, float, float], state: RigState
) -> None:
    finding = judge(matches(cameras.cylinder, turn_deg), cameras.cylinder)
    assert finding.state is state and finding.turn_deg == pytest.approx(np.linalg.norm(turn_deg), abs=0.05)
    assert 0 <= finding.misfit_deg <= finding.turn_deg
    assert finding.summary.startswith(f"{state}: columns off by ")


def test_offsets_are_those_of_the_columns_in_each_direction(cameras: RenderedCameras) -> None:
    cylinder = cameras.cylinder
    finding = judge(matches(cylinder, (0.0, 0.0, 1.0)), cylinder)
    columns = -np.deg2rad(1.0) * cylinder.focal_px
    assert abs(finding.offset_px) == pytest.approx(abs(columns), abs=0.1) and finding.spread_px < 0.3
    assert len(finding.by_azimuth) == SECTORS and sum(count for *_, count in finding.by_azimuth) == 5 * MIN_MATCHES
    assert np.allclose([offset for _, offset, _ in finding.by_azimuth], finding.offset_px, atol=0.3)
    assert finding.left_px < 0.1, "the turn explains all of it"


def test_few_matches_show_nothing_unless_many_clear_points_have_none(cameras: RenderedCameras) -> None:
    few = matches(cameras.cylinder, (0.0, 0.0, 3.0), MIN_MATCHES - 1)
    assert judge(few, cameras.cylinder).state is RigState.UNCHECKED
    none = Matches(few.lower[:20], few.upper[:20], MIN_CONTRAST_POINTS, MIN_CONTRAST_POINTS)
    assert judge(none, cameras.cylinder).state is RigState.BROKEN
    assert judge(Matches(few.lower[:0], few.upper[:0], 0, 0), cameras.cylinder).state is RigState.UNCHECKED
