"""Accounting of the buffers of a camera: valid, broken and missing ones."""

from __future__ import annotations

from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraState

_SEQUENCE_COUNT: Final = 2**32  # v4l2_buffer.sequence is an unsigned 32-bit counter


class BufferAccounting:
    """Count missing, broken and restarted buffers in the camera's state; reads no clock and no device."""

    def __init__(self, state: CameraState) -> None:
        self._state = state
        self._last_sequence: int | None = None

    def restart(self) -> None:
        """Expect the first sequence number of a new stream."""
        self._last_sequence = None

    def accept(self, buffer: v4l2.V4l2Buffer, min_bytes: int) -> bool:
        """Count a buffer; True if it holds an image.

        min_bytes: size of the smallest complete image. A shorter buffer, or one with the driver's error flag, is
        counted as an error.
        """
        self._count_missing(buffer.sequence)
        if buffer.flags & v4l2.BUFFER_ERROR or buffer.bytesused < min_bytes:
            self._state.errors += 1
            return False
        return True

    def _count_missing(self, sequence: int) -> None:
        """Count the buffers missing since the last one; a step backwards counts as a restart of the sequence."""
        if self._last_sequence is not None:
            step = (sequence - self._last_sequence) % _SEQUENCE_COUNT
            if 0 < step < _SEQUENCE_COUNT // 2:
                self._state.drops += step - 1
            else:
                self._state.restarts += 1
        self._last_sequence = sequence
