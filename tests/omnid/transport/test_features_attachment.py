"""The zenoh attachment of a panorama."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.errors import OmnidError
from omnid.transport.features_attachment import MOST, features_from_bytes, features_to_bytes


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{}",
        b"[]",
        b"\xff",
        b"[" * 3000,
        b'{"inliers":3,"rejected":[],"new":[]}',
        b'{"inliers":[[1]],"rejected":[],"new":[]}',
        bytes(1 << 18),
    ],
)
def test_refuses_bytes_that_are_no_features(data: bytes) -> None:
    with pytest.raises(OmnidError, match="attached to a panorama"):
        features_from_bytes(data)


def test_features_are_limited_in_number_and_finite() -> None:
    many = np.zeros((3 * MOST, 2))
    assert len(features_from_bytes(features_to_bytes({"inliers": many, "rejected": many, "new": many}))["new"]) == MOST
    wild = b'{"inliers":[[NaN,1],[1e300,2],[3,4]],"rejected":[],"new":[]}'
    assert features_from_bytes(wild)["inliers"].tolist() == [[3.0, 4.0]]
