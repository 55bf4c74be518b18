"""Masks: the mirror's rim, drawn and real and rims that moved."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.models.camera import Mask
from calib.rim import find_rim

Image = NDArray[np.uint8]
CENTER, RADIUS = (391.3, 377.6), 340.7
V, U = np.mgrid[:768, :768].astype(float)
R = np.hypot(U - CENTER[0], V - CENTER[1])


def world(seed: int = 0) -> NDArray[np.float64]:
    """Return an image with light and dark patches."""
    coarse = np.random.default_rng(seed).uniform(40, 230, (24, 24))
    return np.asarray(cv2.resize(coarse, (768, 768), interpolation=cv2.INTER_LINEAR))


def drawn(inner: float = 0.0, outer: float = RADIUS, blur: float = 0.8, noise: float = 2.0) -> Image:
    fine = np.where((outer > R) & (inner <= R), world(), 9.0)
    soft = cv2.GaussianBlur(fine, (0, 0), blur) + np.random.default_rng(1).normal(0, noise, fine.shape)
    return np.clip(soft, 0, 255).astype(np.uint8)


def assert_ring(mask: Mask | None, inner: float = 0.0, outer: float = RADIUS) -> None:
    assert mask is not None
    assert mask.center == pytest.approx(CENTER, abs=0.25)
    assert mask.outer_px == pytest.approx(outer - 1.5, abs=0.6)
    assert mask.inner_px == pytest.approx(inner + 1.5 if inner else 0.0, abs=3.0 if inner else 0.0)


@pytest.mark.parametrize("guess", [CENTER, (384.0, 384.0), (410.0, 350.0)])
def test_finds_a_drawn_rim_from_different_guesses(guess: tuple[float, float]) -> None:
    assert_ring(find_rim(drawn(), guess))


def squares() -> NDArray[np.float64]:
    return np.asarray((U // 40 + V // 40) % 2 * 255)


NOTHING: dict[str, Callable[[], NDArray[np.float64]]] = {
    "black": lambda: 0 * U,
    "noise": lambda: np.random.default_rng(0).uniform(0, 255, U.shape),
    "squares": squares,
    "soft vignette": lambda: 220 * np.exp(-((R / 300) ** 2)),
    "square": lambda: np.where((np.abs(U - 384) < 300) & (np.abs(V - 384) < 300), 150, 5),
    "ellipse": lambda: np.where(np.hypot((U - 384) / 1.15, V - 384) < 300, 150, 5),
    "tiny": lambda: np.zeros((20, 20)),
    "most of the rim dark": lambda: np.where((R < RADIUS) & (V < 500) & (U > 300), world(), 5),
    "blobs": lambda: cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, U.shape), (0, 0), 25) * 30 - 3700,
}


@pytest.mark.parametrize("name", NOTHING)
def test_returns_none_for_images_without_a_rim(name: str) -> None:
    image = np.clip(NOTHING[name](), 0, 255).astype(np.uint8)
    assert find_rim(image, (image.shape[1] / 2, image.shape[0] / 2)) is None


def test_finds_the_rim_of_a_real_mirror(shared_data: Path) -> None:
    """Ten images of one mirror: the image cuts off its rim above and below, and the lens is in its middle."""
    images: list[Any] = [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((shared_data / "vmr_board").glob("*.jpg"))
    ]
    found = [find_rim(image, (512.0, 384.0)) for image in images]
    masks = [mask for mask in found if mask is not None]
    assert len(masks) >= 8
    rings = np.array([(*mask.center, mask.inner_px, mask.outer_px) for mask in masks])
    assert (np.ptp(rings, axis=0) < (1.0, 1.0, 3.0, 0.6)).all()
    np.testing.assert_allclose(rings.mean(axis=0), (516.7, 384.1, 79.0, 451.7), atol=1.0)
