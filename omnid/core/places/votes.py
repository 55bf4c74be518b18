"""Votes of features for a keyframe and a turn: a better shortlist than the signature, where people hide the view."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from omnid.core.places.place_map import PlaceFeatures
from omnid.core.places.recognition import RATIO, distances

VOTERS: Final = 64  # features of a frame that vote; they are evenly spread, the strongest ones first
BINS: Final = 24  # Bins of the yaw angle; three neighbours count together.


def votes(here: PlaceFeatures, there: PlaceFeatures, width: int) -> tuple[int, float]:
    """Return how many features of a frame have a match in a keyframe at one turn, and that turn [rad].

    The turn is the yaw from the keyframe to the frame; width: columns of the panorama. Of places that are not the same,
    the matches are few, and their turns differ.
    """
    if len(there.views) < 2 or not len(here.views):
        return 0, 0.0
    here = PlaceFeatures(here.descriptors[:VOTERS], here.views[:VOTERS])
    squared = distances(here, there)
    best = squared.argmin(axis=1)
    nearest, second = np.partition(squared, 1, axis=1)[:, :2].T
    voting = np.flatnonzero(nearest < RATIO**2 * second)
    # A turn to the left moves the world to the right.
    turned = (here.views[voting, 0] - there.views[best[voting], 0]) % width
    counts = np.bincount((turned * (BINS / width)).astype(np.intp) % BINS, minlength=BINS)
    together = counts + np.roll(counts, 1) + np.roll(counts, -1)
    bin = int(together.argmax())
    return int(together[bin]), (bin + 0.5) * 2 * math.pi / BINS
