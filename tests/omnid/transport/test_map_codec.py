"""CDR of the maps."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.errors import OmnidError
from omnid.transport import map_codec

STAMP_NS = 1_700_000_123_987_654_321


def test_point_cloud_needs_a_confidence_for_each_point() -> None:
    with pytest.raises(OmnidError, match="2 confidences for 3 points"):
        map_codec.point_cloud_cdr(STAMP_NS, "rig", np.zeros((3, 3)), np.zeros(2))
