"""A sensor's faults: struts and hub, a darker rim, changing light, noise, JPEG."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from calib.models.camera import Mask
from omnid.simulation.rendering.sensor import FITTING_GREY, MountedSensor, Sensor, fittings, vignetting

SIZE = (120, 100)
MASK = Mask((59.5, 49.5), 5.0, 48.0)
PLAIN = Sensor(noise_sigma=0.0, blur_px=0.0, black_level=0.0)
IDEAL = np.full(SIZE[::-1], 200.0, np.float32)


def exposed(sensor: Sensor, seed: int = 1) -> np.ndarray:
    return MountedSensor.of(sensor, MASK, SIZE).expose(IDEAL, np.random.default_rng(seed))


def test_a_sensor_without_faults_shows_the_ideal_image() -> None:
    assert (exposed(PLAIN) == 200).all() and (exposed(replace(PLAIN, brightness=0.5)) == 100).all()
    assert (exposed(replace(PLAIN, black_level=10.0)) == round(200 * (1 - 10 / 255) + 10)).all()


def test_struts_go_outwards_from_the_hub() -> None:
    hidden = fittings(Sensor(strut_angles_deg=(0.0,), strut_width=0.05, hub=0.1), MASK, SIZE)
    assert hidden[50, 100] == 1 and hidden[50, 20] == 0 and hidden[90, 60] == 0 and hidden[50, 60] == 1
    assert not fittings(Sensor(), MASK, SIZE).any()
    shown = exposed(replace(PLAIN, hub=0.1))
    assert shown[50, 60] == FITTING_GREY and shown[50, 100] == 200


def test_the_rim_is_darker_than_the_middle() -> None:
    falloff = vignetting(Sensor(vignette=0.4), MASK, SIZE)
    assert falloff[49, 59] > 0.99 and abs(falloff[49, 59 + 48] - 0.6) < 0.02 and falloff.min() >= 0.6 - 1e-6


def test_noise_and_flicker_have_their_sizes() -> None:
    assert abs(exposed(replace(PLAIN, noise_sigma=4.0)).std() - 4.0) < 0.2
    means = [exposed(replace(PLAIN, brightness=0.5, flicker=0.1), seed).mean() for seed in range(60)]
    assert 7 < np.std(means) < 13


def test_jpeg_is_the_image_nearly() -> None:
    image = exposed(replace(PLAIN, vignette=0.4))
    found = cv2.imdecode(np.frombuffer(MountedSensor.of(PLAIN, MASK, SIZE).jpeg(image), np.uint8), cv2.IMREAD_UNCHANGED)
    assert found.shape == image.shape and np.abs(found.astype(int) - image).max() < 6
