"""What came from a port while no answer did, in words: what was measured, then what makes a port send that."""

from __future__ import annotations

from typing import Final

KEPT: Final = 256  # bytes that are looked at
LEAST: Final = 4  # bytes from which something follows
SHOWN: Final = 40  # characters of a text
SHOWN_BYTES: Final = 8
_TEXT: Final = frozenset(b"\t\r\n" + bytes(range(32, 127)))


class Heard:
    """The first bytes that were sent and that came, since a question was asked."""

    def __init__(self) -> None:
        self._sent, self._came = b"", b""

    def sent(self, data: bytes) -> None:
        """Keep what was sent."""
        self._sent = (self._sent + data)[:KEPT]

    def came(self, data: bytes) -> None:
        """Keep what has come."""
        self._came = (self._came + data)[:KEPT]

    @property
    def is_echo(self) -> bool:
        """True if what comes back is what was sent."""
        return len(self._came) >= LEAST and self._came[: len(self._sent)] == self._sent[: len(self._came)]

    def words(self, baud: int) -> str:
        """Return what came and what to check; baud: of the port."""
        came = self._came
        # 1. Nothing, or what was sent.
        if not came:
            return f"gave no answer, not a byte; check power, cable, the baud rate ({baud}) and motor.protocol"
        if self.is_echo:
            return (
                "gave no answer of its own: what comes back is what was sent; are TX and RX joined, or does the "
                "adapter echo (RS-485)?"
            )
        # 2. Text, or bytes as another baud rate makes them.
        if sum(byte in _TEXT for byte in came) >= 0.95 * len(came):
            text = came.decode("ascii", "replace").strip()[:SHOWN]
            return f"answers, but not in its protocol: {text!r}; is it another firmware, or another motor.protocol?"
        return (
            f"answers, but not in its protocol: bytes as {came[:SHOWN_BYTES].hex(' ')}, which are no text; check the "
            f"baud rate ({baud}, motor.baud), motor.protocol and the cable"
        )
