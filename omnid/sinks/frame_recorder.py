"""What the robot sees and does, written down while it happens: images as they came, poses, commands, maps, states."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Final, TypeAlias

from drivers.frame import Frame
from drivers.logs.rotating_log import RotatingLog, RotatingLogState
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, Outgoing, OutgoingMessage, StateReports
from omnid.transport.codec import ERROR, OK, DiagnosticStatus
from omnid.transport.image_codec import image_cdr, image_topic

Recorded: TypeAlias = Frame | Outgoing
_WAITING: Final = 256  # of what other threads add
_HELD: Final = 128  # of these, so that none is forgotten while its time does not come: a clock may have been set
_POSE_AGE_NS: Final = 10**9  # a pose is told when it has been found, seldom later than that after its images


class FrameRecorder:
    """A sink for a live run. Give it an inbox that forgets (policy NEWEST): no stage waits for a disk.

    offset_ns: from the stamps of the messages to Unix time; the encoder has the same. Without an encoder it takes
    frames only. Never raises; `state` counts what was lost beyond its inbox, `unfit` what could not be encoded.
    """

    def __init__(self, log: RotatingLog, robot: str, encode: Encoder | None = None, *, offset_ns: int = 0) -> None:
        self._log, self._robot, self._encode, self._offset_ns = log, robot, encode, offset_ns
        self._states = StateReports()
        self._added: deque[tuple[OutgoingMessage, int]] = deque(maxlen=_WAITING)
        self._files = 0
        self.unfit = 0

    @property
    def state(self) -> RotatingLogState:
        """How the recording is."""
        return self._log.state

    def status(self) -> DiagnosticStatus:
        """How it goes, and what it could not keep beyond its inbox."""
        state = self.state
        counts = {name: str(getattr(state, name)) for name in
                  ("messages", "lost", "refused", "files", "deleted", "stops")}
        values = {"file": state.file, **counts, "unfit": str(self.unfit)}
        return DiagnosticStatus(
            "omnid: recording", ERROR if state.status == "stopped" else OK, state.problem or state.status, values
        )

    def process(self, message: Recorded) -> None:
        """Records what there is to say about a message."""
        stamp_ns = message.stamp_ns + self._offset_ns
        self._write_added(stamp_ns if isinstance(message, OdometryUpdate) else stamp_ns - _POSE_AGE_NS)
        try:
            self._write(self._encoded(message, stamp_ns), stamp_ns)
            if isinstance(message, OdometryUpdate) and self._encode is not None:
                self._write(self._state(replace(message, stamp_ns=stamp_ns)), stamp_ns)
        except OmnidError:  # a stamp that is no time
            self.unfit += 1

    def add(self, said: OutgoingMessage, stamp_ns: int) -> None:
        """Records a message that is ready, at its Unix time, once that has been reached; from any thread.

        Poses tell their state too, at the time of their images: statuses shall not go back in time for that.
        """
        self._added.append((said, stamp_ns))

    def finish(self) -> None:
        """Makes the last file whole."""
        self.close()

    def close(self) -> None:
        """Writes what was added since and makes the last file whole; a second call does nothing."""
        self._write_added()
        self._log.close()

    def _write_added(self, until_ns: int | None = None) -> None:
        """Writes what was added, of times up to the given one."""
        while self._added and (until_ns is None or self._added[0][1] <= until_ns or len(self._added) > _HELD):
            said, at_ns = self._added.popleft()
            self._write([said], at_ns)

    def _encoded(self, message: Recorded, stamp_ns: int) -> Iterable[OutgoingMessage]:
        if isinstance(message, Frame):
            return [OutgoingMessage(image_topic(message), *image_cdr(message, stamp_ns))]
        return self._encode(message) if self._encode is not None else []

    def _state(self, odometry: OdometryUpdate) -> Iterable[OutgoingMessage]:
        """The state of the odometry when it changes, and once in every file."""
        if self._files != self.state.files:
            self._files, self._states = self.state.files, StateReports()
        return self._states(odometry)

    def _write(self, messages: Iterable[OutgoingMessage], stamp_ns: int) -> None:
        for topic, schema, payload in messages:
            name = topic if topic.startswith("/") else f"/{self._robot}/{topic}"
            self._log.write(name, schema, payload, stamp_ns)
