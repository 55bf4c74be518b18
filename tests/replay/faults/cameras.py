"""Faults of the cameras, done to the frames of a LogCamera."""

from __future__ import annotations

from tests.replay.faults.trial import SPOILT, Outcome, Place, driving, goes_on, stands, trial
from tests.replay.live import wait_until


def spoilt(place: Place, line: str, part: str, word: str) -> Outcome:
    """What becomes of images that are spoilt for a while."""
    with driving(place, module=SPOILT) as (daemon, operator, base):
        daemon.write_line(line)
        wait_until(lambda: word in operator.message(part), f"'{word}'")
        stands(base)
        said = f"{part}: {operator.message(part)}; odometry: {operator.message('odometry')}"
        daemon.write_line("both ok")
        goes_on(base)
    return Outcome("alive, recovered by itself", "stopped, turned again with the next command", said)


@trial("upper camera stuck")
def upper_stuck(place: Place) -> Outcome:
    """No more images of one camera."""
    return spoilt(place, "upper mute", "pairing", "no images of the upper camera")


@trial("lower camera stuck")
def lower_stuck(place: Place) -> Outcome:
    """No more images of the other."""
    return spoilt(place, "lower mute", "pairing", "no images of the lower camera")


@trial("both cameras stuck")
def both_stuck(place: Place) -> Outcome:
    """No more images at all."""
    return spoilt(place, "both mute", "pairing", "no images of the lower and the upper camera")


@trial("garbage JPEG")
def garbage(place: Place) -> Outcome:
    """Noise between a JPEG's first and last bytes."""
    return spoilt(place, "lower garbage", "pairing", "cannot be decoded")


@trial("JPEG cut in half")
def cut(place: Place) -> Outcome:
    """Images whose end is missing."""
    return spoilt(place, "both cut", "pairing", "cannot be decoded")


@trial("black frames")
def black(place: Place) -> Outcome:
    """The light goes off."""
    return spoilt(place, "both black", "odometry", "lost")
