"""A pair of VESCs, one on the port and one behind it on CAN: commands <-> packets, no I/O.

Source: VESC firmware (github.com/vedderb/bldc): comm/packet.c, comm/commands.c, datatypes.h, confgenerator.c.

    packet  = 02 length payload crc 03, or 03 and a length of two bytes from 256 on; crc: CRC-16 (0x1021, start 0) of
              the payload; all numbers big-endian
    payload = COMM_SET_RPM (8), int32 electrical rpm | COMM_GET_VALUES_SELECTIVE (50), uint32 mask
            | COMM_GET_APPCONF (17) | COMM_FORWARD_CAN (34), uint8 id, payload for that one

The motor stops after the "timeout" of the App Settings without a command. The timeout is a part of the application's
configuration, of which only the first fields (signature, id, timeout) are the same in all firmware versions: it is read
and compared at the connection, and can be set only by VESC Tool. Bit 21 of the values marks that it has expired.
Each reply carries the id of its controller.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Callable

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.motor_protocol import DifferentialDrive, T, Transaction

SET_RPM, GET_APPCONF, FORWARD_CAN, GET_VALUES_SELECTIVE = 8, 17, 34, 50  # COMM_PACKET_ID in datatypes.h
MASK = 1 << 7 | 1 << 8 | 1 << 15 | 1 << 17 | 1 << 21  # erpm, input voltage, fault, id, status
MAX_PAYLOAD = 512  # bytes; PACKET_MAX_PL_LEN in packet.h
MAX_ERPM = 0x7FFFFFFF  # int32
SHORT, LONG, END = 2, 3, 3  # first byte of a packet, also the size of its head: 1 or 2 bytes of length; last byte
_CONFIG = struct.Struct(">xIBI")  # signature, id, timeout [ms]
_VALUES = struct.Struct(">BIihBB")  # command, mask, erpm, 0.1 V, fault, id; then the status where the firmware has it


def packet(payload: bytes) -> bytes:
    """Return the packet of a payload of 1 to 512 bytes."""
    size = len(payload)
    head = bytes((SHORT, size)) if size < 256 else bytes((LONG,)) + size.to_bytes(2, "big")
    return head + payload + _tail(payload)


def forwarded(can_id: int, payload: bytes) -> bytes:
    """Return the payload that forwards another one to the controller with this id on the CAN bus."""
    return bytes((FORWARD_CAN, can_id)) + payload


class PacketFramer:
    """Splits a byte stream into payloads; a byte that does not start a packet is skipped."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the payloads of the packets that end in data."""
        self._buffer += data
        payloads, start = [], 0
        while (head := self._buffer[start : start + LONG]) and (head[0] not in (SHORT, LONG) or len(head) >= head[0]):
            # 1. The length by the first bytes, 0 where no packet begins with them.
            length = int.from_bytes(head[1 : head[0]], "big") if head[0] in (SHORT, LONG) else 0
            first, last = start + head[0], start + head[0] + length
            end = last + len(_tail(b""))
            is_packet = 0 < length <= MAX_PAYLOAD
            if is_packet and end > len(self._buffer):
                break  # It is incomplete.
            # 2. A whole packet with the right checksum, or else a byte that starts none.
            payload = bytes(self._buffer[first:last])
            if is_packet and self._buffer[last:end] == _tail(payload):
                payloads.append(payload)
                start = end
            else:
                start += 1
        del self._buffer[:start]
        return payloads

    def reset(self) -> None:
        """Discard the incomplete packet."""
        self._buffer.clear()


def _tail(payload: bytes) -> bytes:
    """Return CRC and end of a packet."""
    return binascii.crc_hqx(payload, 0).to_bytes(2, "big") + bytes((END,))


class Vesc:
    """Channel 1 is the controller on the port, channel 2 the one with the drive's can_id."""

    baud = 115_200
    framer = PacketFramer

    def __init__(self, drive: DifferentialDrive) -> None:
        self._drive = drive

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Read the timeouts of both controllers and return the shorter one [ms].

        Raises DriverError where one is off or longer than requested.
        """
        query = bytes((GET_APPCONF,))
        first, second = yield from self._query_both(query, _config)
        for can_id, timeout_ms in (first, second):
            if not 0 < timeout_ms <= watchdog_ms:
                raise DriverError(
                    f"watchdog of {watchdog_ms} ms requested, {timeout_ms} ms in force in the VESC with id {can_id}; "
                    "set Timeout in VESC Tool (App Settings, General), or raise motor.watchdog_ms to at least its time"
                )
        return float(min(first[1], second[1]))

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send the queries, then both speeds, at once; a speed sent before would clear an expired timeout."""
        erpm_per_mps = self._drive.rpm_per_mps * self._drive.pole_pairs
        speeds = self._drive.channels(command, MAX_ERPM / erpm_per_mps)
        commands = [struct.pack(">Bi", SET_RPM, round(mps * erpm_per_mps)) for mps in speeds]
        packets = packet(commands[0]) + packet(forwarded(self._drive.can_id, commands[1]))
        query = struct.pack(">BI", GET_VALUES_SELECTIVE, MASK)
        (_, first), (_, second) = yield from self._query_both(query, _values, packets)
        velocity_mps, yaw_rate_radps = self._drive.motion(first[0] / erpm_per_mps, second[0] / erpm_per_mps)
        battery_v, fault, expired = min(first[1], second[1]), first[2] or second[2], first[3] or second[3]
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, expired, fault, battery_v)

    def _query_both(
        self, query: bytes, parse: Callable[[bytes], tuple[int, T] | None], commands: bytes = b""
    ) -> Transaction[tuple[tuple[int, T], tuple[int, T]]]:
        """Send a query to both controllers, then the commands; return (id, parsed reply) of each."""
        replies: dict[bool, tuple[int, T]] = {}  # the key is True for the controller on CAN
        can_id = self._drive.can_id
        frame = yield packet(query) + packet(forwarded(can_id, query)) + commands
        while True:
            reply = parse(frame)
            if reply is not None:
                replies[reply[0] == can_id] = reply
            if len(replies) == 2:
                return replies[False], replies[True]
            frame = yield b""


def _config(payload: bytes) -> tuple[int, int] | None:
    """Return id and timeout [ms], None of another payload."""
    if payload[0] != GET_APPCONF or len(payload) < _CONFIG.size:
        return None
    _, can_id, timeout_ms = _CONFIG.unpack_from(payload)
    return can_id, timeout_ms


def _values(payload: bytes) -> tuple[int, tuple[int, float, int, bool]] | None:
    """Return id and (electrical rpm, battery [V], fault, True if the timeout expired), None of another payload.

    The fault is a number of mc_fault_code in datatypes.h; 0 is none.
    """
    if payload[0] != GET_VALUES_SELECTIVE or not _VALUES.size <= len(payload) <= _VALUES.size + 1:
        return None
    _, mask, erpm, decivolt, fault, can_id = _VALUES.unpack_from(payload)
    if mask != MASK:
        return None
    expired = len(payload) > _VALUES.size and bool(payload[-1] & 1)
    return can_id, (erpm, decivolt / 10, fault, expired)
