"""Simulated pair of VESCs, one on the port and one behind it on CAN; source in drivers/motors/protocols/vesc.py."""

from __future__ import annotations

import math
import struct

from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.protocols.vesc import PacketFramer
from drivers.motors.simulated.simulated_base import LEFT, RIGHT, SimulatedBase, reply_to

_LOCAL_ID = 77
_SET_RPM, _GET_APPCONF, _ALIVE, _FORWARD_CAN, _GET_VALUES_SELECTIVE = 8, 17, 30, 34, 50
_SIZES = {_SET_RPM: 4, _GET_APPCONF: 0, _ALIVE: 0, _GET_VALUES_SELECTIVE: 4}


class SimulatedVesc:
    """timeout_ms: what both were given by VESC Tool."""

    def __init__(self, drive: DifferentialDrive | None = None, timeout_ms: int = 500) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = timeout_ms
        self._framer = PacketFramer()

    def feed(self, data: bytes) -> bytes:
        """The answers to all packets that end in data."""
        return reply_to(self.base, self._framer, self._route, data)

    def _route(self, payload: bytes) -> bytes:
        """To the one on the port, or on to the one on CAN; nobody answers for an id that is not there."""
        if payload[0] != _FORWARD_CAN:
            return self._answer(0, payload)
        if len(payload) > 2 and payload[1] == self.base.drive.can_id:
            return self._answer(1, payload[2:])
        self.base.errors += 1
        return b""

    def _answer(self, channel: int, payload: bytes) -> bytes:
        if _SIZES.get(payload[0]) != len(payload) - 1:
            self.base.errors += 1
            return b""
        if payload[0] == _SET_RPM:
            self._spin(channel, struct.unpack(">i", payload[1:])[0])
        elif payload[0] == _ALIVE:
            self.base.feed(self._side(channel))
        elif payload[0] == _GET_APPCONF:
            return _framed(self._config(channel))
        else:
            return _framed(self._values(channel, struct.unpack(">I", payload[1:])[0]))
        return b""

    def _spin(self, channel: int, erpm: int) -> None:
        self.base.commands += 1
        self.base.command_channel(channel, erpm / self._erpm_per_mps())

    def _config(self, channel: int) -> bytes:
        """Signature, id, timeout, and as much of the rest as makes it a long packet."""
        head = struct.pack(">BIBI", _GET_APPCONF, 0x1234ABCD, self._id(channel), round(self.base.watchdog_ms))
        return head + bytes(range(256)) + bytes(150)

    def _values(self, channel: int, mask: int) -> bytes:
        fields = {
            7: struct.pack(">i", round(self.base.channels_mps()[channel] * self._erpm_per_mps())),
            8: struct.pack(">h", round(self.base.battery_v * 10)),
            15: bytes((self.base.fault,)),
            17: bytes((self._id(channel),)),
            21: bytes((self.base.expired[self._side(channel)],)),
        }
        wanted = [data for bit, data in fields.items() if mask >> bit & 1]
        return struct.pack(">BI", _GET_VALUES_SELECTIVE, mask) + b"".join(wanted)

    def _id(self, channel: int) -> int:
        return self.base.drive.can_id if channel else _LOCAL_ID

    def _side(self, channel: int) -> int:
        return RIGHT if bool(channel) != self.base.drive.swapped else LEFT

    def _erpm_per_mps(self) -> float:
        drive = self.base.drive
        return 60 * drive.pole_pairs * drive.gear / (math.tau * drive.wheel_radius_m)


def _framed(payload: bytes) -> bytes:
    """The packet of a payload, its checksum bit by bit."""
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    size = len(payload)
    head = bytes((2, size)) if size < 256 else bytes((3, size >> 8, size & 255))
    return head + payload + bytes((crc >> 8, crc & 255, 3))
