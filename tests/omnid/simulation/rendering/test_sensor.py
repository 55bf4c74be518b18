"""A sensor's faults: changing light and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.models.camera import Mask
from omnid.simulation.rendering.sensor import MountedSensor, Sensor

SIZE = (120, 100)
MASK = Mask((59.5, 49.5), 5.0, 48.0)
PLAIN = Sensor(noise_sigma=0.0, blur_px=0.0, black_level=0.0)
IDEAL = np.full(SIZE[::-1], 200.0, np.float32)


def exposed(sensor: Sensor, seed: int = 1) -> np.ndarray:
    return MountedSensor.of(sensor, MASK, SIZE).expose(IDEAL, np.random.default_rng(seed))


def test_a_sensor_without_faults_shows_the_ideal_image() -> None:
    assert (exposed(PLAIN) == 200).all() and (exposed(replace(PLAIN, brightness=0.5)) == 100).all()
    assert (exposed(replace(PLAIN, black_level=10.0)) == round(200 * (1 - 10 / 255) + 10)).all()


def test_noise_and_flicker_have_their_sizes() -> None:
    assert abs(exposed(replace(PLAIN, noise_sigma=4.0)).std() - 4.0) < 0.2
    means = [exposed(replace(PLAIN, brightness=0.5, flicker=0.1), seed).mean() for seed in range(60)]
    assert 7 < np.std(means) < 13
