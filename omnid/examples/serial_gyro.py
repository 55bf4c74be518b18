"""A serial gyro for a robot: `python -m omnid.examples.serial_gyro PORT`; --help shows its options.

Reads an IMU of WitMotion (WT61, WT901 ...) and publishes each angular velocity as sensor_msgs/msg/Imu on `cmd/imu`, as
any program may do for any other gyro. Set the IMU to 115200 baud and 100 Hz with its maker's program, and state its
orientation on the base by motion.imu_rpy_deg of the robot's settings.

The IMU sends packets of 11 bytes by itself: 0x55, a type, four little-endian numbers of 16 bits, and the sum of the ten
bytes before. Type 0x52 holds the angular velocities about x, y, z in units of 2000 / 32768 degrees per second.
"""

from __future__ import annotations

import argparse
import math
import struct
import sys
import time
from collections.abc import Iterator, Sequence

import serial  # type: ignore[import-untyped]

from drivers.motion import GyroSample
from omnid.transport.sensor_codec import gyro_cdr
from omnid.transport.session import HERE, BusConfig, open_client

PACKET = struct.Struct("<BB4hB")
RADPS_PER_UNIT = math.radians(2000.0) / 32768
FRAME = "imu_link"  # not base_link: the robot turns the axes of this frame by its own settings


def rates_radps(received: bytearray) -> Iterator[tuple[float, float, float]]:
    """Remove the packets from the bytes; yield the angular velocities about x, y, z of the valid ones [rad/s]."""
    while len(received) >= PACKET.size:
        packet = bytes(received[: PACKET.size])
        _, kind, x, y, z, _, total = PACKET.unpack(packet)
        if packet[:1] != b"\x55" or sum(packet[:-1]) & 0xFF != total:
            del received[:1]  # this byte was not the start of a packet
            continue
        del received[: PACKET.size]
        if kind == 0x52:
            yield x * RADPS_PER_UNIT, y * RADPS_PER_UNIT, z * RADPS_PER_UNIT


def main(argv: Sequence[str] | None = None) -> int:
    """Publish until the port is gone (exit code 1, so that a service manager starts it again) or Ctrl-C."""
    parser = argparse.ArgumentParser(description="publish a serial gyro to a robot")
    parser.add_argument("port", help="serial port, by a persistent name: /dev/serial/by-id/...")
    parser.add_argument("--baud", type=int, default=115_200)
    parser.add_argument("--robot", default="omnid")
    parser.add_argument("--connect", default=HERE)
    args = parser.parse_args(argv)
    session = open_client(BusConfig(robot=args.robot, connect=(args.connect,)))
    received = bytearray()
    try:
        with serial.Serial(args.port, args.baud, timeout=0.1, exclusive=True) as port:
            port.reset_input_buffer()  # The time of bytes that have arrived before is unknown.
            while True:
                received += port.read(max(1, port.in_waiting))
                now_ns = time.time_ns()
                for x, y, z in rates_radps(received):
                    payload = gyro_cdr(GyroSample(now_ns, x, y, z), now_ns, FRAME)
                    session.put(f"{args.robot}/cmd/imu", payload)
    except OSError as error:  # SerialException is an OSError, and in_waiting raises a plain one
        print(f"serial_gyro: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        session.close()  # type: ignore[no-untyped-call]  # the stub has no return type


if __name__ == "__main__":
    sys.exit(main())
