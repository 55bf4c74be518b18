"""Simulated pair of VESCs, one on the port and one behind it on CAN; sources as in drivers/motors/protocols/vesc.py."""

from __future__ import annotations

import math
import struct

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.vesc import S_PER_MIN, PacketFramer
from drivers.motors.simulated.simulated_base import SimulatedBase, SimulatedFirmware

_LOCAL_ID = 77  # CAN id of the controller on the serial port.
_SET_RPM, _GET_APPCONF, _ALIVE, _FORWARD_CAN, _GET_VALUES_SELECTIVE = 8, 17, 30, 34, 50  # COMM_PACKET_ID
_ARGUMENT_BYTES = {_SET_RPM: 4, _GET_APPCONF: 0, _ALIVE: 0, _GET_VALUES_SELECTIVE: 4}
_SIGNATURE = 0x1234ABCD  # any: the driver ignores it
_CRC_POLYNOMIAL = 0x1021


class SimulatedVesc(SimulatedFirmware):
    """A pair of controllers; timeout_ms: of both, as set by VESC Tool."""

    def __init__(self, drive: DifferentialDrive | None = None, timeout_ms: int = 500) -> None:
        super().__init__(SimulatedBase(drive), PacketFramer())
        self.base.watchdog_ms = timeout_ms

    def _handle(self, frame: bytes) -> bytes:
        """Pass the payload to the controller on the port or on CAN; no reply for an unknown id."""
        if frame[0] != _FORWARD_CAN:
            return self._reply(0, frame)
        if len(frame) > 2 and frame[1] == self.base.drive.can_id:
            return self._reply(1, frame[2:])
        return self._reject(b"")

    def _reply(self, channel: int, payload: bytes) -> bytes:
        if _ARGUMENT_BYTES.get(payload[0]) != len(payload) - 1:
            return self._reject(b"")
        if payload[0] == _SET_RPM:
            self._drive(channel, struct.unpack(">i", payload[1:])[0])
        elif payload[0] == _ALIVE:
            self.base.feed(self.base.side_of(channel))
        elif payload[0] == _GET_APPCONF:
            return _packet(self._config(channel))
        else:
            return _packet(self._values(channel, struct.unpack(">I", payload[1:])[0]))
        return b""

    def _drive(self, channel: int, erpm: int) -> None:
        self.base.commands += 1
        self.base.command_channel(channel, erpm / self._erpm_per_mps())

    def _config(self, channel: int) -> bytes:
        """Return signature, id, timeout, and a filling that makes it a long packet."""
        head = struct.pack(">BIBI", _GET_APPCONF, _SIGNATURE, self._id(channel), round(self.base.watchdog_ms))
        return head + bytes(range(256)) + bytes(150)

    def _values(self, channel: int, mask: int) -> bytes:
        fields = {  # bit of the mask -> value
            7: struct.pack(">i", round(self.base.channels_mps()[channel] * self._erpm_per_mps())),
            8: struct.pack(">h", round(self.base.battery_v * 10)),
            15: bytes((self.base.fault,)),
            17: bytes((self._id(channel),)),
            21: bytes((self.base.expired[self.base.side_of(channel)],)),
        }
        wanted = [data for bit, data in fields.items() if mask >> bit & 1]
        return struct.pack(">BI", _GET_VALUES_SELECTIVE, mask) + b"".join(wanted)

    def _id(self, channel: int) -> int:
        return self.base.drive.can_id if channel else _LOCAL_ID

    def _erpm_per_mps(self) -> float:
        drive = self.base.drive
        return S_PER_MIN * drive.pole_pairs * drive.gear / (math.tau * drive.wheel_radius_m)


def _packet(payload: bytes) -> bytes:
    """Return the packet of a payload; the CRC is computed bit by bit, to check the driver's."""
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ _CRC_POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
    size = len(payload)
    head = bytes((2, size)) if size < 256 else bytes((3, size >> 8, size & 255))
    return head + payload + bytes((crc >> 8, crc & 255, 3))
