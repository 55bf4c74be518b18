"""Frozen cameras: images with all pixels as before are counted and make no pair; single ones stop nothing."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import pytest

from calib.rig import Rig
from drivers.frame import Camera, Frame
from omnid.camera_config import PairConfig
from omnid.stages.synchronise import FROZEN_IMAGES, KEPT, RepeatedImages, Synchronise
from tests.simulation import build

SIZE = 256
PERIOD_NS = 33_333_333
LIVING = range(1000, 1100)  # numbers of images that differ


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build("two_walls", seed=3, size=SIZE, pairs=2).rig


def image(number: int) -> np.ndarray:
    """Return a grey wall with the noise of the frame with this number."""
    noise = np.random.default_rng(number).integers(-2, 3, (SIZE, SIZE))
    return (90 + noise).astype(np.uint8)


def seen(numbers: Iterable[int]) -> tuple[list[bool], RepeatedImages]:
    repeated = RepeatedImages()
    return [repeated.add(image(number)) for number in numbers], repeated


def test_a_motionless_scene_has_no_repeated_image() -> None:
    flags, repeated = seen(LIVING)
    assert not any(flags) and not repeated.frozen and repeated.count == 0


def test_a_camera_freezes_and_lives_again() -> None:
    _, repeated = seen([1, *[2] * (FROZEN_IMAGES + 1)])
    assert repeated.frozen and repeated.count == FROZEN_IMAGES
    repeated.add(image(3))
    assert not repeated.frozen and repeated.longest == FROZEN_IMAGES


@pytest.mark.parametrize("buffers", range(2, KEPT + 1))
def test_a_driver_that_hands_out_its_buffers_in_turn_is_frozen(buffers: int) -> None:
    flags, repeated = seen([*range(100, 120), *list(range(buffers)) * 5])
    assert repeated.frozen and not any(flags[: 20 + buffers]) and all(flags[20 + 2 * buffers :])


def frames(lower: Iterable[int], upper: Iterable[int]) -> list[Frame]:
    def shot(camera: Camera, index: int, number: int) -> Frame:
        return Frame(index, 10**12 + index * PERIOD_NS, camera, "png", cv2.imencode(".png", image(number))[1])

    return [
        frame
        for index, (low, up) in enumerate(zip(lower, upper, strict=True))
        for frame in (shot("lower", index, low), shot("upper", index, up + 10**6))
    ]


@pytest.mark.hazard("H34")
@pytest.mark.parametrize("dead", [("lower",), ("upper",), ("lower", "upper")])
def test_pairs_of_a_frozen_camera_are_left_out(rig: Rig, dead: tuple[Camera, ...]) -> None:
    """The images of the other camera go on; two images after the camera lives again there is a pair again."""
    pairing, living = Synchronise(rig, PairConfig()), list(range(30))
    frozen = [*living[:10], *[9] * 10, *living[20:]]
    shots = frames(*(frozen if camera in dead else living for camera in ("lower", "upper")))
    during = [pairing.process(frame) for frame in shots[:40]]
    assert pairing.frozen == list(dead)
    made = [pair for frame in [*shots[40:]] if (pair := pairing.process(frame)) is not None]
    assert [pair is not None for pair in during[1::2]] == [True] * 10 + [False] * 10 and len(made) == 10
    assert pairing.counts == {
        "pairs": 20,
        "unpaired_lower": 0,
        "unpaired_upper": 0,
        "broken": 0,
        "repeated_lower": 10 * ("lower" in dead),
        "repeated_upper": 10 * ("upper" in dead),
    }
    assert [pair.seq for pair in made] == list(range(10, 20)) and pairing.frozen == []


def test_a_simulator_without_noise_may_use_them(rig: Rig) -> None:
    pairing = Synchronise(rig, PairConfig(repeated_images="use"))
    made = [pair for frame in frames([1] * 20, [1] * 20) if (pair := pairing.process(frame)) is not None]
    assert len(made) == 20 and pairing.frozen == ["lower", "upper"] and pairing.counts["repeated_lower"] == 19
