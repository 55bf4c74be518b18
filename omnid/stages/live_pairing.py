"""Two images of one instant out of the frames of two cameras that run freely."""

from __future__ import annotations

import math
from collections import Counter, deque

from calib.rig import Rig
from drivers.frame import Camera, Frame
from omnid.config import PairConfig
from omnid.messages import FramePair
from omnid.stages.log_pairing import Decoder, Image

WAITING = 4  # frames of a camera that may wait for their partner
FORGETS = 0.02  # share of a new skew in the slow mean: some fifty pairs
OTHERS: dict[Camera, Camera] = {"lower": "upper", "upper": "lower"}


class Skew:
    """How far the upper camera's stamps are from the lower's, and whether that wanders."""

    def __init__(self) -> None:
        self.mean_ns = self.first_ns = math.nan  # slow mean now, and when it had settled
        self.most_ns = 0
        self._pairs = 0

    def add(self, skew_ns: int) -> None:
        """Takes the skew of a pair."""
        self._pairs += 1
        share = max(FORGETS, 1 / self._pairs)
        self.mean_ns = skew_ns if self._pairs == 1 else self.mean_ns + share * (skew_ns - self.mean_ns)
        self.most_ns = max(self.most_ns, abs(skew_ns))
        if self._pairs == round(1 / FORGETS):
            self.first_ns = self.mean_ns

    @property
    def wandered_ns(self) -> float:
        """How far the slow mean has gone since it had settled; NaN before."""
        return self.mean_ns - self.first_ns


class LivePair:
    """Joins each frame with the one of the other camera that is nearest in time; decodes only what is joined.

    Frames of either camera come in order, those of both in any. What finds no partner is counted; a camera that falls
    silent costs nothing but its partner's frames.
    """

    def __init__(self, rig: Rig, config: PairConfig) -> None:
        self._decode = Decoder(rig)
        self._tolerance_ns = round(config.tolerance_ms * 1e6)
        self._waiting: dict[Camera, deque[Frame]] = {"lower": deque(), "upper": deque()}
        self._unpaired: Counter[Camera] = Counter()
        self._pairs = 0
        self.skew = Skew()
        self.newest_ns: dict[Camera, int] = {"lower": 0, "upper": 0}  # stamp of each camera's newest frame

    @property
    def fault(self) -> str:
        """Why the first of the broken images could not be decoded; empty where there is none."""
        return self._decode.fault

    @property
    def counts(self) -> dict[str, int]:
        """Pairs made, frames of either camera that found no partner, images that could not be decoded."""
        return {"pairs": self._pairs, "unpaired_lower": self._unpaired["lower"],
                "unpaired_upper": self._unpaired["upper"], "broken": self._decode.broken}

    def process(self, frame: Frame) -> FramePair | None:
        """The pair that this frame completes."""
        self.newest_ns[frame.camera] = frame.stamp_ns
        others = self._waiting[OTHERS[frame.camera]]
        partner = min(others, key=lambda other: abs(other.stamp_ns - frame.stamp_ns), default=None)
        if partner is None or abs(partner.stamp_ns - frame.stamp_ns) > self._tolerance_ns:
            self._wait(frame)
            return None
        self._leave_behind(partner)
        self._leave_behind(frame)
        return self._joined(*((frame, partner) if frame.camera == "lower" else (partner, frame)))

    def _wait(self, frame: Frame) -> None:
        waiting = self._waiting[frame.camera]
        waiting.append(frame)
        if len(waiting) > WAITING:
            waiting.popleft()
            self._unpaired[frame.camera] += 1

    def _leave_behind(self, frame: Frame) -> None:
        """Forgets the frame, and what waited from before it: no later frame can be its partner."""
        waiting = self._waiting[frame.camera]
        while waiting and waiting[0].stamp_ns <= frame.stamp_ns:
            self._unpaired[frame.camera] += waiting.popleft() is not frame

    def _joined(self, lower: Frame, upper: Frame) -> FramePair | None:
        self.skew.add(upper.stamp_ns - lower.stamp_ns)
        images = self._images(lower, upper)
        if images is None:
            return None
        seq = self._pairs
        self._pairs += 1
        return FramePair(seq, lower.stamp_ns, *images)

    def _images(self, lower: Frame, upper: Frame) -> tuple[Image, Image] | None:
        below = self._decode(lower)
        above = self._decode(upper)
        return None if below is None or above is None else (below, above)

    def finish(self) -> tuple[()]:
        """Counts the frames that still wait."""
        for camera, waiting in self._waiting.items():
            self._unpaired[camera] += len(waiting)
            waiting.clear()
        return ()
