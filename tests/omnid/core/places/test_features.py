"""Features of a place: corners of known depth; descriptors that light and scale leave as they are."""

from __future__ import annotations

import numpy as np

from omnid.core.places.features import FEATURES, describe, describe_patches
from tests.omnid.core.scenery import RenderedCameras, texture, wrapped

PIXELS = np.array([[60.0, 50], [150, 60], [240, 70], [330, 55], [2, 60]])
SIDES = np.full(5, 32.0)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (N, M) of descriptors."""
    return np.asarray(np.linalg.norm(a[:, None].astype(float) - b[None].astype(float), axis=2))


def test_features_have_known_depths_and_are_bounded(cameras: RenderedCameras) -> None:
    frame = cameras.frame(1, np.eye(4))
    found = describe(frame)
    assert 50 < len(found.views) == len(found.descriptors) <= FEATURES and found.descriptors.shape[1:] == (128,)
    assert np.isfinite(found.views).all() and (found.views[:, 2] > found.views[:, 1]).all()
    columns, rows = np.rint(found.views[:, :2]).astype(int).T
    assert frame.usable[rows, columns % frame.lower.width].all()
    assert found.nbytes < 45_000 and len(describe(cameras.darkness(1)).views) == 0


def test_another_light_changes_nothing_and_another_patch_much() -> None:
    image = texture(1)
    plain = describe_patches(wrapped(image), PIXELS, SIDES)
    dimmer = describe_patches(wrapped((0.6 * image + 30).astype(np.uint8)), PIXELS, SIDES)
    apart = distances(plain, dimmer)
    assert plain.shape == (5, 128) and plain.dtype == np.uint8
    assert np.diag(apart).max() < 60 and apart[~np.eye(5, dtype=bool)].min() > 150
