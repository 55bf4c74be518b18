"""The paper's claims on small logs that POV-Ray rendered."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.paper import measures
from tests.bench.paper.scenes import Experiment

# Rendered by POV-Ray, another renderer than omnid's: brick --seed 1 --size 512 --pairs 1, turns --size 448 --pairs 5.
SMALL = Path(__file__).parent / "small"


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
