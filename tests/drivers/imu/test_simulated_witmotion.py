"""The simulated IMU: the real driver reads from it what it was told to measure."""

from __future__ import annotations

import math
import time
from contextlib import closing
from itertools import islice

import pytest

from drivers.imu.simulated_witmotion import SimulatedWitMotion, gyro_packet
from drivers.imu.witmotion import RADPS_PER_UNIT, PacketReader, WitMotionGyro


def test_the_driver_reads_the_rates() -> None:
    with (
        closing(SimulatedWitMotion(lambda: (0.01, -0.5, 1.5), 200.0)) as imu,
        closing(WitMotionGyro(imu.port, 115_200)) as gyro,
    ):
        samples = list(islice(gyro.samples(), 10))
        assert gyro.broken == 0
    for sample in samples:
        assert (sample.x_radps, sample.y_radps, sample.z_radps) == pytest.approx((0.01, -0.5, 1.5), abs=RADPS_PER_UNIT)
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(stamps)
    imu.close()


def test_rates_beyond_the_range_are_the_largest() -> None:
    ((x, y, z),) = PacketReader().feed(gyro_packet((99.0, -99.0, 0.0)))
    assert x == -y == pytest.approx(math.radians(2000), rel=1e-3) and z == 0.0


def test_packets_that_are_not_read_are_counted() -> None:
    with closing(SimulatedWitMotion(lambda: (0.0, 0.0, 0.0), 20_000.0)) as imu:
        while not imu.unsent:
            time.sleep(0.01)
