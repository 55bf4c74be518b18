"""Models of a rig's cameras for a drive."""

from __future__ import annotations

import pytest

from calib.fit.drive.camera_terms import DISTORTIONS, DriveModelScore, best_model


@pytest.mark.parametrize(
    ("held_out", "expected"),
    [
        ((0.2, 0.05, 0.0499), ("p1", "p2")),
        ((0.2, 0.199, 0.1985), ()),
        ((0.2, 0.1, 0.05), ("k1", "p1", "p2")),
    ],
)
def test_the_fewest_terms_that_no_more_improve_are_chosen(
    held_out: tuple[float, ...], expected: tuple[str, ...]
) -> None:
    scores = [DriveModelScore(terms, error) for terms, error in zip(DISTORTIONS, held_out, strict=True)]
    assert best_model(scores).distortion == expected
