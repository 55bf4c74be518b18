"""Features of a place: corners of known depth; descriptors that light and scale leave as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from omnid.core.places.descriptor_kernels import describe as kernel
from omnid.core.places.features import FEATURES, _cell_weights, describe, describe_patches
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


def test_a_patch_twice_as_large_is_seen_at_half_the_resolution() -> None:
    image = texture(2, sigma_px=6.0)
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    large = describe_patches(wrapped(image), PIXELS[:4], 2 * SIDES[:4])
    small = describe_patches(wrapped(half), (PIXELS[:4] - 0.5) / 2, SIDES[:4])
    apart = distances(large, small)
    assert np.diag(apart).max() < 0.5 * apart[~np.eye(4, dtype=bool)].min()


def test_patches_run_across_the_seam_and_shift_with_the_panorama() -> None:
    image = texture(3)
    moved = describe_patches(wrapped(np.roll(image, 100, axis=1)), PIXELS + np.array([100, 0]), SIDES)
    assert np.array_equal(describe_patches(wrapped(image), PIXELS, SIDES), moved)


def test_no_patches_and_no_contrast_are_no_error() -> None:
    blank = wrapped(np.full((120, 480), 90, np.uint8))
    assert describe_patches(blank, PIXELS[:0], SIDES[:0]).shape == (0, 128)
    assert not describe_patches(blank, PIXELS, SIDES).any()


@pytest.mark.parametrize("angle", np.arange(-3.1, 3.2, 0.31).tolist())
def test_the_gradient_of_a_ramp_counts_in_the_two_directions_beside_its_own(angle: float) -> None:
    y, x = np.mgrid[:18, :18].astype(np.float32)
    found = np.zeros((1, 128), np.uint8)
    kernel((5 * np.float32(np.cos(angle)) * x + 5 * np.float32(np.sin(angle)) * y)[None], _cell_weights(), found)
    cells = found.reshape(16, 8).astype(int)
    direction = (angle / (2 * np.pi) * 8) % 8
    low, high = int(direction), (int(direction) + 1) % 8
    assert not np.delete(cells, [low, high], axis=1).any() and cells[:, [low, high]].any(axis=1).all()
    nearer, farther = (low, high) if direction % 1 < 0.5 else (high, low)
    assert (cells[:, nearer] >= cells[:, farther]).all()
    # Shares at the rim of the window are below the limit of a histogram's entries.
    ratio = (cells[0, farther] / cells[0, nearer]) ** 2
    assert abs(ratio - min(direction % 1, 1 - direction % 1) / max(direction % 1, 1 - direction % 1)) < 0.05
