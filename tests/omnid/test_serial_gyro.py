"""The example of a serial gyro: packets on a pty become messages on the bus that the robot reads as a gyro's."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import threading
import tty
from contextlib import closing
from pathlib import Path

import pytest
import zenoh

from drivers.motion import GyroSample
from omnid.transport.codec import IMU_SCHEMA
from omnid.transport.sensor_codec import sample_from_cdr
from tests.ports import free_port

PATIENCE_S = 20.0  # for the start of a program on a busy machine


def packet(kind: int, *numbers: int) -> bytes:
    """Return a packet of the IMU with four numbers."""
    body = struct.pack("<BB4h", 0x55, kind, *numbers)
    return body + bytes([sum(body) & 0xFF])


def test_a_serial_gyro_is_published_on_the_bus() -> None:
    device, host = os.openpty()
    tty.setraw(host)
    endpoint, received, enough = f"tcp/127.0.0.1:{free_port()}", list[bytes](), threading.Event()
    settings = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))

    def take(sample: zenoh.Sample) -> None:
        received.append(sample.payload.to_bytes())
        if len(received) >= 10:
            enough.set()

    damaged = bytearray(packet(0x52, 1, 2, 3, 0))
    damaged[5] ^= 1
    # Acceleration, angular velocity of (0, -3, 16384) units, a damaged packet and a lost start.
    turn = (
        packet(0x51, 1, 2, 2048, 2000) + packet(0x52, 0, -3, 16384, 0) + bytes(damaged) + packet(0x53, 5, 6, 7, 0)[4:]
    )
    command = [sys.executable, "-m", "omnid.examples.serial_gyro", os.ttyname(host), "--robot", "rover"]
    with closing(zenoh.open(config)) as session:
        session.declare_subscriber("rover/cmd/imu", take)
        program = subprocess.Popen(
            [*command, "--connect", endpoint], cwd=Path(__file__).parents[2], stderr=subprocess.PIPE
        )
        try:
            for _ in range(round(PATIENCE_S / 0.02)):
                os.write(device, turn)
                if enough.wait(0.02):
                    break
        finally:
            os.close(host)
            os.close(device)  # the device is unplugged
        _, errors = program.communicate(timeout=PATIENCE_S)
    samples = [sample_from_cdr(payload, IMU_SCHEMA, lambda unix_ns: unix_ns) for payload in received]
    assert len(samples) >= 10 and program.returncode == 1 and b"Traceback" not in errors
    for sample in samples:
        assert isinstance(sample, GyroSample) and not sample.of_base, "the robot's settings turn its axes"
        assert sample.x_radps == 0.0 and sample.z_radps == pytest.approx(math.radians(1000.0)), "half of 2000 deg/s"
        assert sample.y_radps == pytest.approx(-3 * math.radians(2000.0) / 32768)
