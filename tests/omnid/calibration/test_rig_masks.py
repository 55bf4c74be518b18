"""Masks of a calibrated rig: what is said where no rim is found."""

from __future__ import annotations

import numpy as np

from calib.fit.boards.rig_fit import fit_rig
from omnid.calibration.image_pairs import PairedImages
from omnid.calibration.rig_masks import masked_rig
from tests.calib.fit.boards.rig_views import LOWER, ODD, UPPER, pairs


def test_without_a_rim_the_mask_is_searched_later() -> None:
    found = fit_rig(pairs(ODD, 6), ODD, (LOWER, UPPER), refined=False)
    blank = {"p0": np.full((768, 780), 90, np.uint8)}
    rig, warnings = masked_rig(found, PairedImages((blank, blank)), None, with_struts=False)
    assert rig.lower.mask is None and rig.upper.mask is None
    assert len(warnings) == 2 and all("the daemon searches" in line for line in warnings), warnings
