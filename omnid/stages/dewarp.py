"""Dewarping: mirror images to panoramas (Dang et al. 2012, section III.A)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Maps, remap_tables, visible
from omnid.config import PanoramaConfig
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.errors import OmnidError
from omnid.messages import FramePair, Panoramas
from omnid.stages.geometry import Geometry

MIN_SHARED_PART = 0.05  # of the panorama that both cameras must see


class Dewarp:
    """Rectifies both images of a pair; the remap tables are computed once."""

    def __init__(self, geometry: Geometry, config: PanoramaConfig) -> None:
        self._pad_px = config.pad_px
        rig, cylinder = geometry.rig, geometry.cylinder
        self._lower, self._upper = (remap_tables(rig, m, cylinder, config.pad_px) for m in (rig.lower, rig.upper))
        both = visible(rig.lower, self._lower, config.rim_margin_px)
        both &= visible(rig.upper, self._upper, config.rim_margin_px)
        self._visible = _inner(both, config.margin_px)[:, config.pad_px : -config.pad_px]
        self._visible.setflags(write=False)
        if self._visible.mean() < MIN_SHARED_PART:
            raise OmnidError(
                f"the cameras share {self._visible.mean():.1%} of the panorama, less than {MIN_SHARED_PART:.0%}: check "
                "the rig's transforms and masks, panorama.rim_margin_px and panorama.margin_px"
            )

    def process(self, pair: FramePair) -> Panoramas:
        """Return the panoramas of a pair."""
        lower, upper = self._panorama(pair.lower, self._lower), self._panorama(pair.upper, self._upper)
        return Panoramas(pair.seq, pair.stamp_ns, lower, upper, self._visible)

    def _panorama(self, image: NDArray[np.uint8], maps: Maps) -> PaddedPanorama:
        return PaddedPanorama(np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8), self._pad_px)


def _inner(region: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """Return the region (H, W) without a margin along its border and along the first and last rows."""
    side = 2 * margin_px + 1
    inner = cv2.erode(region.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1) > 0
    inner[: margin_px + 1], inner[len(inner) - margin_px - 1 :] = False, False
    return np.ascontiguousarray(inner)
