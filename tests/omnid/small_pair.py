"""The depth of a pair of tiny images, for messages of which a test looks at something else."""

from __future__ import annotations

import numpy as np

from omnid.core.types.panorama import PaddedPanorama
from omnid.messages import Panoramas, StereoDepth


def small_depth(stamp_ns: int = 0) -> StereoDepth:
    """Return a depth with panoramas of 6 x 4 pixels, all of whose parts are live."""
    panorama = PaddedPanorama(np.zeros((4, 8), np.uint8), 1)
    return StereoDepth(Panoramas(0, stamp_ns, panorama, panorama, np.ones((4, 6), bool)))
