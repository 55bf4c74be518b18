"""A pair of VESCs, one on the port and one behind it on CAN: commands <-> packets, no I/O.

Source: VESC firmware (github.com/vedderb/bldc): comm/packet.c, comm/commands.c, datatypes.h, confgenerator.c.

    packet  = 02 length payload crc 03, or 03 and a length of two bytes from 256 on; crc: CRC-16 (0x1021, start 0) of
              the payload; all numbers big-endian
    payload = COMM_SET_RPM (8), int32 electrical rpm | COMM_GET_VALUES_SELECTIVE (50), uint32 mask
            | COMM_GET_APPCONF (17) | COMM_FORWARD_CAN (34), uint8 id, payload for that one

The motor stops by itself after the "timeout" of the App Settings, which feeds on every command. It lies in the
application's configuration, of which only the first fields stay the same from firmware to firmware (signature, id,
timeout): it is read at connect and compared, and set by VESC Tool alone. Bit 21 of the values says that it has expired.
Which of two answers is whose says the id in it.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import T, Transaction

SET_RPM, GET_APPCONF, FORWARD_CAN, GET_VALUES_SELECTIVE = 8, 17, 34, 50
MASK = 1 << 7 | 1 << 8 | 1 << 15 | 1 << 17 | 1 << 21  # erpm, input voltage, fault, id, status
LONGEST_PAYLOAD = 512
MAX_ERPM = 0x7FFFFFFF

_CONFIG = struct.Struct(">xIBI")  # signature, id, timeout [ms]
_VALUES = struct.Struct(">BIihBB")  # command, mask, erpm, 0.1 V, fault, id; then the status where the firmware has it


def packet(payload: bytes) -> bytes:
    """The frame around a payload of 1 to 512 bytes."""
    head = b"\x02%c" % len(payload) if len(payload) < 256 else b"\x03" + len(payload).to_bytes(2, "big")
    return head + payload + binascii.crc_hqx(payload, 0).to_bytes(2, "big") + b"\x03"


def forwarded(can_id: int, payload: bytes) -> bytes:
    """The payload that carries another one to the controller with an id on the CAN bus."""
    return bytes((FORWARD_CAN, can_id)) + payload


@dataclass(frozen=True, slots=True)
class Values:
    """What one controller says of itself."""

    erpm: int
    battery_v: float
    fault: int
    expired: bool


class PacketFramer:
    """Payloads out of a byte stream in any pieces; a byte that starts no packet is garbage, the next one is tried."""

    def __init__(self) -> None:
        self.garbage = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The payloads of the packets that end in data."""
        self._buffer += data
        payloads = []
        start = 0
        while (size := _size(self._buffer, start)) is not None:
            payload = _payload(self._buffer, start, size) if size else None
            if payload is not None:
                payloads.append(payload)
            self.garbage += payload is None
            start += 1 if payload is None else size
        del self._buffer[:start]
        return payloads

    def reset(self) -> None:
        """Forgets the piece of a packet in hand."""
        self.garbage += len(self._buffer)
        self._buffer.clear()


def _size(buffer: bytearray, start: int) -> int | None:
    """The size of the packet that starts there; 0 where none can, None where more has to come."""
    head = buffer[start : start + 3]
    if not head or (head[0] in (2, 3) and len(head) < head[0]):
        return None
    if head[0] not in (2, 3):
        return 0
    length = head[1] if head[0] == 2 else head[1] << 8 | head[2]
    if not (1 if head[0] == 2 else 255) <= length <= LONGEST_PAYLOAD:
        return 0
    size = head[0] + length + 3
    return size if len(buffer) - start >= size else None


def _payload(buffer: bytearray, start: int, size: int) -> bytes | None:
    payload = bytes(buffer[start + buffer[start] : start + size - 3])
    crc = int.from_bytes(buffer[start + size - 3 : start + size - 1], "big")
    return payload if buffer[start + size - 1] == 3 and binascii.crc_hqx(payload, 0) == crc else None


class Vesc:
    """Channel 1 is the controller on the port, channel 2 the one with the drive's can_id."""

    baud = 115_200

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive

    def framer(self) -> PacketFramer:
        """Packets."""
        return PacketFramer()

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Reads both timeouts; DriverError where one is off or longer than asked. Gives the shorter one [ms]."""
        first, second = yield from self._both((bytes((GET_APPCONF,)),) * 2, _config)
        for can_id, timeout_ms in (first, second):
            if not 0 < timeout_ms <= watchdog_ms:
                raise DriverError(
                    f"watchdog of {watchdog_ms} ms asked, {timeout_ms} ms in force in the VESC with id {can_id}; set "
                    "Timeout in VESC Tool (App Settings, General), or motor.watchdog_ms to at least what it has"
                )
        return float(min(first[1], second[1]))

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """The questions and both speeds at once; the questions first, for an order hides that the timeout had come."""
        erpm_per_mps = 60 * self._drive.turns_per_m * self._drive.pole_pairs
        speeds = self._drive.channels(command, MAX_ERPM / erpm_per_mps)
        orders = [struct.pack(">Bi", SET_RPM, round(mps * erpm_per_mps)) for mps in speeds]
        ordered = packet(orders[0]) + packet(forwarded(self._drive.can_id, orders[1]))
        question = struct.pack(">BI", GET_VALUES_SELECTIVE, MASK)
        first, second = yield from self._both((question, question), _values, ordered)
        motion = self._drive.motion(first[1].erpm / erpm_per_mps, second[1].erpm / erpm_per_mps)
        return MotorStatus(motion[0], math.nan, motion[1], first[1].expired or second[1].expired,
                           first[1].fault or second[1].fault, min(first[1].battery_v, second[1].battery_v))  # fmt: skip

    def _both(
        self, questions: tuple[bytes, bytes], parse: Callable[[bytes], tuple[int, T] | None], orders: bytes = b""
    ) -> Transaction[tuple[tuple[int, T], tuple[int, T]]]:
        """What each of the two answers, as id and value."""
        answers: dict[bool, tuple[int, T]] = {}
        frame = yield packet(questions[0]) + packet(forwarded(self._drive.can_id, questions[1])) + orders
        while True:
            answer = parse(frame)
            if answer is not None:
                answers[answer[0] == self._drive.can_id] = answer
            self.bad_frames += answer is None
            if len(answers) == 2:
                return answers[False], answers[True]
            frame = yield b""


def _config(payload: bytes) -> tuple[int, int] | None:
    if payload[0] != GET_APPCONF or len(payload) < _CONFIG.size:
        return None
    _, can_id, timeout_ms = _CONFIG.unpack_from(payload)
    return can_id, timeout_ms


def _values(payload: bytes) -> tuple[int, Values] | None:
    if payload[0] != GET_VALUES_SELECTIVE or not _VALUES.size <= len(payload) <= _VALUES.size + 1:
        return None
    _, mask, erpm, decivolt, fault, can_id = _VALUES.unpack_from(payload)
    expired = bool(payload[_VALUES.size :] and payload[-1] & 1)
    return (can_id, Values(erpm, decivolt / 10, fault, expired)) if mask == MASK else None
