"""The example programs of a serial gyro and of the acceptance drive."""

from __future__ import annotations

import json
import math
import os
import re
import runpy
import struct
import subprocess
import sys
import threading
import tty
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zenoh

from drivers.motion import GyroSample
from omnid.formats.tum import tum_row
from omnid.transport.codec import IMU_SCHEMA
from omnid.transport.sensor_codec import sample_from_cdr
from tests.ports import free_port
from tests.simulation.paths import planar_poses

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


STEP_NS, STAND, STEP_M, DISTANCE_M, NOISE_M = 10**8, 40, 0.05, 12.0, 1e-3


def write_rounds(path: Path, scales: tuple[float, ...]) -> None:
    """Write a trajectory of rounds, each with its own scale, and a pause half-way."""
    there = np.arange(0, DISTANCE_M + 1e-9, STEP_M)
    there = np.insert(there, len(there) // 2, [there[len(there) // 2]] * 50)
    round_m = np.concatenate([there, np.full(STAND, DISTANCE_M), there[::-1], np.zeros(STAND)])
    way_m = np.concatenate([np.zeros(STAND), *(scale * round_m for scale in scales)])
    noise = NOISE_M * np.random.default_rng(1).standard_normal((len(way_m), 2))
    poses = planar_poses(np.column_stack([way_m, np.zeros(len(way_m))]) + noise, np.zeros(len(way_m)))
    stamps_ns = 1_700_000_000 * 10**9 + STEP_NS * np.arange(len(way_m))
    path.write_text("\n".join(tum_row(int(stamp), T) for stamp, T in zip(stamps_ns, poses, strict=True)))


@pytest.mark.parametrize(
    ("scales", "code", "longest"),
    [((1.0, 1.0, 1.0), 0, "+0.0"), ((1.02, 0.98), 1, "+2.0")],  # the latter is right in the mean only
)
def test_errors_of_rounds(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    scales: tuple[float, ...],
    code: int,
    longest: str,
) -> None:
    path = tmp_path / "est.txt"
    write_rounds(path, scales)
    monkeypatch.setattr("sys.argv", ["acceptance", str(path), str(DISTANCE_M)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("omnid.examples.acceptance", run_name="__main__")
    out = capsys.readouterr().out
    assert ended.value.code == code, out
    assert out.count("round of ") == len(scales) and out.count(" to ") == 2 * len(scales)
    errors = re.findall(r"m, ([+-]\d+\.\d)", out)
    assert max(errors, key=float).startswith(longest), out
