"""A WitMotion IMU on a pty: packets, damaged bytes, a port that is silent or gone."""

from __future__ import annotations

import math
import os
import random
import threading
import time
import tty
from collections.abc import Iterator
from itertools import islice, pairwise

import pytest

from drivers.errors import DriverError
from drivers.imu import witmotion
from drivers.imu.witmotion import PACKET, PacketReader, WitMotionGyro


def packet(kind: int, *numbers: int) -> bytes:
    """Return a packet with four numbers."""
    body = PACKET.pack(0x55, kind, *numbers, 0)[:-1]
    return body + bytes([sum(body) & 0xFF])


def turn(z: int) -> bytes:
    """Return what the IMU sends for one measurement: acceleration, angular velocity, angle."""
    return packet(0x51, 1, 2, 2048, 2000) + packet(0x52, 0, -3, z, 2000) + packet(0x53, 5, 6, 7, 2000)


@pytest.fixture
def port() -> Iterator[tuple[int, str]]:
    """The device's end of a pty, and the name of the other one."""
    device, host = os.openpty()
    tty.setraw(host)
    yield device, os.ttyname(host)
    for descriptor in (device, host):
        os.close(descriptor)


def test_rates_are_those_of_the_data_sheet() -> None:
    """16384 of 32768 are half of 2000 degrees per second."""
    ((x, y, z),) = PacketReader().feed(turn(16384))
    assert (x, z) == (0.0, pytest.approx(math.radians(1000))) and y < 0


def test_packets_are_found_again_after_damaged_bytes() -> None:
    rng, reader = random.Random(4), PacketReader()
    stream = bytearray()
    for k in range(300):
        stream += turn(k)[rng.randrange(30) :] if k % 7 == 0 else turn(k)  # the start of it was lost
        if k % 10 == 1:
            stream[-5] ^= 1
    found = [z for start in range(0, len(stream), 13) for _, _, z in reader.feed(bytes(stream[start : start + 13]))]
    assert 250 <= len(found) <= 300 and reader.broken > 0
    known = {round(k * witmotion.RADPS_PER_UNIT, 9) for k in range(300)}
    assert sum(round(z, 9) not in known for z in found) <= 3  # a sum of eight bits passes one of 256 by chance


def test_samples_of_a_port(port: tuple[int, str]) -> None:
    device, name = port
    gyro = WitMotionGyro(name, 115_200)
    os.write(device, turn(1000))  # old: nothing tells when it was measured
    threading.Timer(0.3, os.write, (device, b"".join(turn(k) for k in range(20)))).start()
    samples = list(islice(gyro.samples(), 20))
    gyro.close()
    assert [round(sample.z_radps / witmotion.RADPS_PER_UNIT) for sample in samples] == list(range(20))
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(stamps) and stamps[-1] - stamps[0] < 10**9
    assert list(gyro.samples()) == []


def test_samples_that_arrive_together_are_as_far_apart_as_usual(port: tuple[int, str]) -> None:
    device, name = port
    gyro = WitMotionGyro(name, 115_200)

    def send() -> None:
        """Send a turn soon, one each 20 ms or somewhat later, and 20 at once in the end."""
        for k in range(31):  # the first one may be dropped, as from before the first read
            time.sleep(0.02 if k else 0.002)
            os.write(device, turn(k))
        time.sleep(0.4)
        os.write(device, b"".join(turn(30 + k) for k in range(20)))

    sender = threading.Thread(target=send)
    sender.start()
    stamps_ns = [sample.stamp_ns for sample in islice(gyro.samples(), 50)]
    sender.join()
    gyro.close()
    assert min(after - before for before, after in pairwise(stamps_ns[31:])) > 12_000_000
    assert stamps_ns == sorted(stamps_ns)


def test_samples_after_a_pause_are_not_earlier_than_those_before_it(port: tuple[int, str]) -> None:
    device, name = port
    gyro = WitMotionGyro(name, 115_200)

    def send() -> None:
        """Send three turns each 30 ms, and nothing for a second in between."""
        for k in range(30):
            time.sleep(1.0 if k == 10 else 0.03)
            os.write(device, turn(k) + turn(k) + turn(k))

    sender = threading.Thread(target=send)
    sender.start()
    stamps_ns = [sample.stamp_ns for sample in islice(gyro.samples(), 90)]
    sender.join()
    gyro.close()
    assert stamps_ns == sorted(stamps_ns)


def test_a_silent_port_is_opened_again_and_reported(port: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(witmotion, "SILENT_S", 0.3)
    device, name = port
    events: list[str] = []
    gyro = WitMotionGyro(name, 9600, events.append)
    os.write(device, b"\x55garbage at another baud rate")
    received = threading.Event()

    def send() -> None:
        """Send turns from 1.5 s on, as a sensor does: what arrives while the port is opened again is lost."""
        received.wait(1.5)
        while not received.wait(0.05):
            os.write(device, turn(7))

    sender = threading.Thread(target=send)
    sender.start()
    (sample,) = islice(gyro.samples(), 1)
    received.set()
    sender.join()
    gyro.close()
    assert sample.z_radps > 0 and gyro.restarts >= 1 and "baud rate" in events[0]


def test_a_port_that_is_gone_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(witmotion, "SILENT_S", 0.3)
    device, host = os.openpty()
    name = os.ttyname(host)
    os.close(host)
    gyro = WitMotionGyro(name)
    os.close(device)
    timer = threading.Timer(1.0, gyro.close)
    timer.start()
    assert list(gyro.samples()) == [] and gyro.restarts >= 1


def test_a_port_that_does_not_exist_is_one_line() -> None:
    with pytest.raises(DriverError, match=r"cannot open the IMU on '/dev/nothing': there is no such port; plug it in"):
        WitMotionGyro("/dev/nothing")
