"""Dead and blind tiles of panoramas; noise and brightness."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.photometry import pair_gains
from omnid.core.stereo.tiles import ALL_LIVE, IN_A_ROW, SIDES, Side, TileMonitor, TileStates, TileSums
from tests.omnid.core.scenery import texture

Image = NDArray[np.uint8]
SHAPE = (256, 900)
NOISE_GREY = {"lower": 2.0, "upper": 2.0}
PART = slice(300, 600)  # columns: a third
INSIDE, OUTSIDE = slice(21, 39), [*range(19), *range(41, 60)]  # tiles of it, and those that it does not touch


def states_after(monitor: TileMonitor, images: dict[Side, Image], noise_grey: dict[Side, float]) -> TileStates:
    """Return the states after a pair."""
    sums = {side: monitor.sums(side, images[side]) for side in SIDES}
    return monitor.update(images, sums, noise_grey)


class Cameras:
    """Two cameras that look at one textured scene, which may move by columns."""

    def __init__(self, noise_grey: float = 2.0, seed: int = 1) -> None:
        self._rng, self._noise_grey = np.random.default_rng(seed), noise_grey
        coarse = self._rng.integers(40, 200, (SHAPE[0] // 4, SHAPE[1] // 4)).astype(np.uint8)
        self.scene = cv2.resize(coarse, SHAPE[::-1], interpolation=cv2.INTER_LINEAR)
        self.monitor = TileMonitor(np.ones(SHAPE, bool))

    def images(self, moved_px: int = 0) -> dict[Side, Image]:
        """Return both images."""
        return {
            side: self._noisy(np.roll(self.scene, (shift, moved_px), (0, 1)))
            for side, shift in zip(SIDES, (0, 8), strict=True)
        }

    def update(self, images: dict[Side, Image]) -> TileStates:
        """Return the states after a pair."""
        return states_after(self.monitor, images, NOISE_GREY)

    def _noisy(self, image: Image) -> Image:
        noise = self._noise_grey * self._rng.standard_normal(SHAPE)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def frozen(cameras: Cameras, pairs: int, side: Side = "upper") -> Iterator[TileStates]:
    """Yield the states of pairs in which the part of one camera stays as it was, while all else moves."""
    kept = cameras.images()[side][:, PART].copy()
    for number in range(pairs):
        images = cameras.images(moved_px=3 * number)
        images[side][:, PART] = kept
        yield cameras.update(images)


@pytest.mark.hazard("H22")
def test_a_part_that_stays_as_it_was_is_dead_at_the_second_repetition_and_live_when_it_changes() -> None:
    """The first image of the part is no repetition."""
    cameras = Cameras()
    states = list(frozen(cameras, IN_A_ROW + 1))
    assert states[-2] is ALL_LIVE
    assert states[-1].dead["upper"][:, INSIDE].all() and not states[-1].dead["upper"][:, OUTSIDE].any()
    assert not states[-1].dead["lower"].any()
    assert states[-1].unknown[INSIDE].all() and not states[-1].unknown[OUTSIDE].any()
    assert cameras.update(cameras.images(moved_px=40)) is ALL_LIVE


def plain_part(scene: Image) -> Image:
    """Return a scene that is plain in the part, for both cameras."""
    scene[:, PART] = 120
    return scene


@pytest.mark.parametrize(
    "changed", [lambda scene: scene, lambda scene: scene // 9, plain_part], ids=["", "dim", "plain"]
)
def test_a_scene_at_rest_is_live_by_its_noise(changed: Callable[[Image], Image]) -> None:
    """Noise of the sensor differs from image to image; a dim scene shows more than noise."""
    cameras = Cameras()
    cameras.scene = changed(cameras.scene)
    assert all(cameras.update(cameras.images()) is ALL_LIVE for _ in range(6))


def test_without_noise_a_scene_in_which_a_little_moves_is_live() -> None:
    """Images of a simulator, or of a camera that removes noise: the base is at rest, somebody walks."""
    cameras = Cameras(noise_grey=0.0)
    for number in range(6):
        images = cameras.images()
        for image in images.values():
            image[:, 30 + 4 * number : 60 + 4 * number] = 90
        assert cameras.update(images) is ALL_LIVE


def test_a_plain_part_is_dead_only_if_it_has_always_changed() -> None:
    """A camera that removes noise repeats what is plain; one that does not shows its noise everywhere."""
    for noise_grey, is_dead in ((2.0, True), (0.0, False)):
        cameras, states = Cameras(noise_grey), ALL_LIVE
        cameras.scene[:, PART] = 120
        kept = cameras.images()["upper"][:, PART].copy()
        for number in range(26 + IN_A_ROW):
            images = cameras.images()
            for image in images.values():  # a lamp flickers on all but the part
                image[:, : PART.start] += np.uint8(number % 2)
                image[:, PART.stop :] += np.uint8(number % 2)
            if number >= 25:
                images["upper"][:, PART] = kept
            states = cameras.update(images)
        assert (states is not ALL_LIVE) == is_dead


@pytest.mark.hazard("H22")
def test_dark_and_saturated_parts_are_blind_at_once() -> None:
    """Each of them, in one image."""
    cameras = Cameras()
    for grey in (4, 255):
        images = cameras.images()
        images["lower"][:, PART] = grey
        states = cameras.update(images)
        assert states.blind["lower"][:, INSIDE].all() and states.unknown[INSIDE].all(), grey
        assert not states.unknown[OUTSIDE].any()


@pytest.mark.hazard("H22")
@pytest.mark.parametrize("side", SIDES)
def test_a_part_that_only_one_camera_shows_blurred_is_blind(side: Side) -> None:
    """A drop on its mirror: the noise stays, the texture goes."""
    cameras, states = Cameras(), ALL_LIVE
    for number in range(IN_A_ROW):
        images = cameras.images(moved_px=3 * number)
        smooth = cv2.GaussianBlur(cameras.images(moved_px=3 * number)[side], (0, 0), 9).astype(float)
        noise = np.random.default_rng(number).normal(0, 2, SHAPE)
        images[side][:, PART] = np.clip(np.rint(smooth + noise), 0, 255).astype(np.uint8)[:, PART]
        states = cameras.update(images)
    assert states.blind[side][:, INSIDE].all() and not states.unknown[OUTSIDE[1:-1]].any()


def test_a_small_panorama_of_little_noise_is_live() -> None:
    """In tiles of a few pixels all keep their greys now and then."""
    rng, shape, noise_grey = np.random.default_rng(3), (80, 272), 0.3
    scene, monitor = np.full(shape, 100.0), TileMonitor(np.ones(shape, bool))
    scene[:, ::9] = 180
    for _ in range(100):
        images = {side: np.rint(scene + noise_grey * rng.standard_normal(shape)).astype(np.uint8) for side in SIDES}
        noise = dict.fromkeys(SIDES, noise_grey)
        assert states_after(monitor, images, noise) is ALL_LIVE


WIDE = (160, 640)
EVERYWHERE = np.ones(WIDE, bool)


def sums_of(image: NDArray[np.uint8], visible: NDArray[np.bool_] = EVERYWHERE) -> TileSums:
    return TileMonitor(visible).sums("lower", image)


def gains_of(lower: NDArray[np.uint8], upper: NDArray[np.uint8], gains: tuple[float, float]) -> tuple[float, float]:
    return pair_gains(sums_of(lower), sums_of(upper), gains)


@pytest.mark.parametrize("share", [1.0, 0.95, 0.6, 0.3])
def test_the_dimmer_panorama_of_a_pair_becomes_as_bright_as_the_other(share: float) -> None:
    lower = (20 + texture(2, WIDE, 4.0)).clip(0, 250)
    pair = lower.astype(np.uint8), (share * np.roll(lower, 6, axis=0)).astype(np.uint8)
    gains = gains_of(*pair, (1.0, 1.0))
    assert gains == (1.0, 1.0 if share > 0.9 else pytest.approx(1 / share, rel=0.03))
    assert gains_of(*pair[::-1], (1.0, 1.0)) == pytest.approx(gains[::-1])
    # A dim pair has gains already, and a third of one camera behind a hand is no dimmer image.
    assert gains_of(*pair, (1.5, 1.5 / share)) == (1.5, 1.5 / share)
    pair[1][:, : WIDE[1] // 3] = 5
    assert gains_of(*pair, (1.0, 1.0)) == pytest.approx(gains, rel=0.03)
    # Two thirds behind it leave no more than a third that shows the brightness.
    pair[1][:, : 2 * WIDE[1] // 3] = 5
    assert share < 0.9 or gains_of(*pair, (1.0, 1.0)) == (1.0, 1.0)
