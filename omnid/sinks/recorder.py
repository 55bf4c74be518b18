"""Recording of a run to MCAP logs: images as received, poses, commands, maps and states, for ROS 2, Foxglove, evo."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TypeAlias

from drivers.frame import Frame
from drivers.logs.mcap_writer import LogWriter, RotatingLog, RotatingLogState
from drivers.motion import MotionSample
from omnid.core.nanoseconds import NS_PER_S
from omnid.engine.robot_clock import RobotClock
from omnid.messages import FramePair
from omnid.sinks.encoder import Encoder, Outgoing
from omnid.transport.sensor_codec import image_cdr, image_topic
from omnid.transport.topics import PUBLISHED, ros_name

Recorded: TypeAlias = Frame | MotionSample | FramePair | Outgoing  # samples are recorded with the pose of their pair


class SingleLog:
    """One log file that is opened for the first message: a run without messages leaves an existing file as it was.

    `write` raises DriverError where the file cannot be written.
    """

    def __init__(self, path: Path, attachments: Mapping[str, bytes]) -> None:
        """attachments: name -> content, written at the start of the file."""
        self.state = RotatingLogState()  # of a recording in several files, which this is not
        self._open = partial(LogWriter, path, dict(attachments))
        self._writer: LogWriter | None = None

    def write(self, topic: str, schema_name: str, data: bytes, stamp_ns: int) -> None:
        """Add a message, CDR with its encapsulation header."""
        self._writer = self._writer or self._open()
        self._writer.write(topic, schema_name, data, stamp_ns)

    def close(self) -> None:
        """Complete the file; a second call does nothing."""
        if self._writer is not None:
            self._writer.close()

    end_file = close  # the clock of a replay has no steps, which would begin another file


class Recorder:
    """A sink that writes every message under `/<robot>/`.

    In a live run its inbox drops, so that no stage waits for the disk, and its log, a RotatingLog, never raises.
    A replay loses nothing: a message that cannot be written raises DriverError.

    Without an encoder only frames are recorded. The caller that runs the graph closes the recorder.
    """

    def __init__(
        self,
        log: SingleLog | RotatingLog,
        robot: str,
        clock: RobotClock,
        encode: Encoder | None = None,
        *,
        images_hz: float = 0.0,
    ) -> None:
        """clock: of the stamps. encode: with the time of the files, the clock's segment_unix_ns.

        images_hz: pairs per second whose images are recorded; 0: all. Single images are always recorded.
        """
        self._log, self._robot, self._encode, self._clock, self._steps = log, robot, encode, clock, clock.steps
        self._period_ns, self._period_index = round(NS_PER_S / images_hz) if images_hz else 1, -1
        self._file_count = 0

    @property
    def state(self) -> RotatingLogState:
        """The state of the files."""
        return self._log.state

    def stats(self) -> dict[str, object]:
        """Return the state of the files, with counts of all that was lost after the inbox."""
        state, names = self.state, ("messages", "lost", "files", "deleted", "problem")
        return {name: getattr(state, name) for name in names} | {"state": state.status, "_error": state.problem}

    def process(self, message: Recorded) -> None:
        """Record a message and, for a pose, its state where it has changed or a new file has begun."""
        # 1. A step of the computer's clock begins a new file: within one, all times are those of one clock.
        self._clock.follow()
        if self._steps != self._clock.steps:
            self._steps = self._clock.steps
            self._log.end_file()
        # 2. Each file contains the states that seldom change.
        stamp_ns, encode = self._clock.segment_unix_ns(message.stamp_ns), self._encode
        if encode is not None and self._file_count not in (0, self.state.files):
            encode.repeat_states()
        self._file_count = self.state.files
        # 3. The message.
        frames: tuple[Frame, ...] = (message,) if isinstance(message, Frame) else ()
        if isinstance(message, FramePair):
            previous, self._period_index = self._period_index, message.stamp_ns // self._period_ns
            frames = message.frames if self._period_index != previous else ()
        elif encode is not None and not isinstance(message, Frame | MotionSample):
            for topic, payload in encode(message):
                self._log.write(ros_name(self._robot, topic), PUBLISHED[topic].schema, payload, stamp_ns)
        for frame in frames:
            frame_ns = self._clock.segment_unix_ns(frame.stamp_ns)
            self._log.write(ros_name(self._robot, image_topic(frame)), *image_cdr(frame, frame_ns), frame_ns)

    def close(self) -> None:
        """Complete the last file; a second call does nothing."""
        self._log.close()
