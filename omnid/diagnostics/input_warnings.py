"""What a run shows to be amiss with its input, in the words of whoever can put it right."""

from __future__ import annotations

from collections.abc import Iterator

from omnid.config import PairConfig
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.stages.stereo import Stereo
from omnid.stages.synchronise import Synchronise


def no_pose(tally: RunStatistics) -> bool:
    """Whether there is not one pose that was measured."""
    return tally.poses == tally.states["lost"]


def input_warnings(pair: Synchronise, stereo: Stereo, tally: RunStatistics, config: PairConfig) -> Iterator[str]:
    """One line for each thing that is amiss."""
    if pair.fault:
        yield f"{pair.counts['broken']} images could not be decoded; the first: {pair.fault}"
    counts = pair.counts
    if not counts["pairs"]:
        yield _no_pair(pair.closest_miss_ms, config.tolerance_ms)
    elif min(counts["unpaired_lower"], counts["unpaired_upper"]) > counts["pairs"]:
        yield (f"most images of both cameras found no partner: the next ones are {pair.closest_miss_ms or 0.0:.3f} ms "
               f"apart, pair.tolerance_ms is {config.tolerance_ms:g}; where none are missing, synchronise the cameras")
    if stereo.exchanged:
        yield ("the images match better the other way round: is --lower the lower camera, and is the rig that of "
               "these cameras?")
    if tally.states["lost"] > tally.poses / 2:
        yield (f"the pose was lost in {tally.states['lost']} of {tally.poses} pairs: is the rig that of these cameras, "
               "is --lower the lower one, are the images bright and sharp?")


def _no_pair(nearest_ms: float | None, tolerance_ms: float) -> str:
    if nearest_ms is None:
        return "not one pair of images: one camera or both gave none, see the drops below"
    return (f"not one pair of images: the stamps of the two cameras are {nearest_ms:.3f} ms apart at best, "
            f"pair.tolerance_ms is {tolerance_ms:g}: set it higher, or the cameras' clocks right")
