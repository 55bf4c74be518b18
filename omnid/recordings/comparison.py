"""Comparison of two recorded runs, as lines for a terminal and a list of differences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from calib.errors import CalibError
from calib.validation import toml_table
from omnid.errors import OmnidError
from omnid.recordings.run_series import STATES, RunSeries
from omnid.recordings.series_differences import (
    Gaps,
    Series,
    aligned,
    changes,
    excess,
    first_transform,
    gaps,
    held,
    in_both,
    pose_excess,
)

MAX_KEYS: Final = 40  # settings that differ and are listed; the number of the others is printed
ATTACHMENTS: Final = (("settings", "omnid.toml"), ("rig", "rig.toml"))
NS_PER_S: Final = 1_000_000_000

Rows: TypeAlias = Iterator[tuple[str, str]]  # subject and text of a line
ABSENT: Final = "nothing"
_MAX_VALUE: Final = 60  # characters


class Tolerance(NamedTuple):
    """Limits within which two runs agree; for commands they are per second."""

    distance_m: float
    angle_rad: float
    shared: float  # minimum share of the longer run's poses that are in both, 0..1

    @property
    def text(self) -> str:
        """The limits in the units of the command line."""
        return f"{1e3 * self.distance_m:g} mm or {math.degrees(self.angle_rad):g} deg"


class RunComparison:
    """Comparison of poses, states and commands of the same stamps.

    align: move B so that the first common poses coincide. Raise OmnidError where no stamp is in both.
    """

    def __init__(self, a: RunSeries, b: RunSeries, tolerance: Tolerance, *, align: bool) -> None:
        self._a, self._b, self._tolerance = a, b, tolerance
        common_a, common_b = in_both(a.poses, b.poses)
        self._require_common(common_a)
        if align:
            common_b = aligned(common_b, first_transform(common_a, common_b))
        self._common, self._aligned = common_a, align
        self._poses = pose_excess(common_a, common_b, tolerance.distance_m, tolerance.angle_rad)
        self._states = [held(run.states, common_a.stamps_ns) for run in (a, b)]
        self._state_excess = excess(self._states[0], self._states[1], (0.0, 0.0))
        drive_a, drive_b = in_both(a.drive, b.drive)
        self._drive_excess = excess(drive_a, drive_b, (tolerance.distance_m, tolerance.angle_rad))

    @property
    def differences(self) -> list[str]:
        """Subjects in which the runs differ by more than the tolerance."""
        first_rows = {
            "poses": self._poses.first,
            "states": self._state_excess.first,
            "commands": self._drive_excess.first,
        }
        subjects = [name for name, row in first_rows.items() if row is not None]
        if self._share < self._tolerance.shared:
            subjects.append(f"less than {self._tolerance.shared:.0%} of the poses are in both")
        return subjects

    def lines(self) -> Iterator[str]:
        """Yield the comparison line by line; the last one is the result."""
        for name, text in self._rows():
            yield f"{name:<10} {text}"
        if self.differences:
            yield f"the runs differ: {', '.join(self.differences)}"
        else:
            is_whole = self._share == 1.0 and not (self._a.warnings or self._b.warnings)
            where = "" if is_whole else " in what could be compared"
            yield f"the runs agree{where}: no difference is larger than {self._tolerance.text}"

    @property
    def _share(self) -> float:
        """Number of common poses by that of the longer run."""
        longest = max(int(run.poses.stamps_ns.size) for run in (self._a, self._b))
        return int(self._common.stamps_ns.size) / longest

    def _require_common(self, common: Series) -> None:
        if not common.stamps_ns.size:
            raise OmnidError(
                f"no pose of {self._a.path} ({_span(self._a)}) and {self._b.path} ({_span(self._b)}) has "
                "the same stamp: the runs used different images; compare a recording with a replay of "
                f"it, `omnid replay {self._a.path} --record again.mcap`"
            )

    def _rows(self) -> Rows:
        for name, run in (("A", self._a), ("B", self._b)):
            yield name, f"{run.path}, {run.topic}: {run.poses.stamps_ns.size} poses, {_span(run)}"
        only_a, only_b = gaps(self._a.poses, self._b.poses), gaps(self._b.poses, self._a.poses)
        yield "in both", f"{self._common.stamps_ns.size} poses ({self._share:.1%} of the longer run)"
        yield "only in A", self._gaps_text(only_a)
        yield "only in B", self._gaps_text(only_b)
        yield from self._pose_rows()
        yield from self._state_rows()
        yield from self._drive_rows()
        for name, file in ATTACHMENTS:
            yield from _table_rows(name, self._a.attachments.get(file), self._b.attachments.get(file))

    def _gaps_text(self, found: Gaps) -> str:
        if not found.missing:
            return "none"
        return (
            f"{found.missing} poses in {found.stretches} gaps, the longest of {found.longest} from "
            f"{self._at(found.longest_ns)} on"
        )

    def _pose_rows(self) -> Rows:
        poses = self._poses
        largest, last = _pose_text(poses.amounts.max(axis=0)), _pose_text(poses.amounts[-1])
        yield "distance", f"at most {largest}; at the end {last}"
        different = poses.first_different
        if different is None:
            yield "", "bit-identical"
        else:
            yield "", f"bit-identical before {self._row(different)}"
        if poses.first is None:
            yield "", f"never more than {self._tolerance.text}"
            return
        yield (
            "",
            (
                f"more than {self._tolerance.text} first at {self._row(poses.first)}: "
                f"{_pose_text(poses.amounts[poses.first])}; at {poses.beyond} poses in all"
            ),
        )
        if poses.first == 0 and not self._aligned:
            yield "", "the first poses differ: --align moves B so that they coincide"

    def _state_rows(self) -> Rows:
        a, b = self._states
        yield "states", f"A {_changes_text(self._a.states)}; B {_changes_text(self._b.states)}"
        if self._state_excess.first is not None:
            row = self._state_excess.first
            yield (
                "",
                (
                    f"different at {self._state_excess.beyond} poses, first at {self._row(row)}: "
                    f"A {_state(a, row)}, B {_state(b, row)}"
                ),
            )

    def _drive_rows(self) -> Rows:
        drive, counts = self._drive_excess, [run.drive.stamps_ns.size for run in (self._a, self._b)]
        yield "commands", f"A {counts[0]}, B {counts[1]}, {drive.stamps_ns.size} of the same stamps"
        if drive.stamps_ns.size:
            yield "", f"difference at most {_drive_text(drive.amounts.max(axis=0))}"
        if drive.first is not None:
            yield (
                "",
                (
                    f"more than {self._tolerance.text} per second first at "
                    f"{self._at(int(drive.stamps_ns[drive.first]))}: {_drive_text(drive.amounts[drive.first])}; "
                    f"{drive.beyond} commands in all"
                ),
            )

    def _row(self, row: int) -> str:
        return self._at(int(self._common.stamps_ns[row]))

    def _at(self, stamp_ns: int) -> str:
        """Return a stamp and the time since the start of run A."""
        since_start_s = (stamp_ns - int(self._a.poses.stamps_ns[0])) / NS_PER_S
        return f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d} ({since_start_s:.3f} s)"


def _table_rows(name: str, a: bytes | None, b: bytes | None) -> Rows:
    """Yield the keys of an attached file that differ.

    They may explain why the runs differ, and do not count as a difference of the runs.
    """
    if a is None or b is None:
        missing = " and ".join(run for run, text in (("A", a), ("B", b)) if text is None)
        yield name, f"not attached to {missing}"
        return
    try:
        found = table_differences(*(toml_table(text, run).values for run, text in (("A", a), ("B", b))))
    except CalibError as error:
        yield name, f"cannot be compared: {error}"
        return
    yield name, f"{len(found)} keys differ" if found else "the same"
    yield from (("", f"{key.path}: A {key.a}, B {key.b}") for key in found[:MAX_KEYS])
    if len(found) > MAX_KEYS:
        yield "", f"and {len(found) - MAX_KEYS} more"


def _span(run: RunSeries) -> str:
    first_ns, last_ns = int(run.poses.stamps_ns[0]), int(run.poses.stamps_ns[-1])
    return f"{first_ns / NS_PER_S:.3f} to {last_ns / NS_PER_S:.3f} s"


def _pose_text(amounts: np.ndarray) -> str:
    return f"{1e3 * amounts[0]:.3f} mm, {math.degrees(amounts[1]):.4f} deg"


def _drive_text(amounts: np.ndarray) -> str:
    return f"{1e3 * amounts[0]:.3f} mm/s, {math.degrees(amounts[1]):.4f} deg/s"


def _changes_text(states: Series) -> str:
    if not states.stamps_ns.size:
        return "reports none"
    return f"{changes(states.values)} changes, {states.values[-1, 1]:.0f} resets"


def _state(states: Series, row: int) -> str:
    number, resets = states.values[row]
    return f"{STATES[int(number)]} after {resets:.0f} resets"


class KeyDifference(NamedTuple):
    """A key whose values differ; the values as one short line each."""

    path: str  # section.key, list[3]
    a: str
    b: str


def table_differences(a: Mapping[str, object], b: Mapping[str, object]) -> list[KeyDifference]:
    """Return the keys of two TOML tables that differ, in the order of the first, then those only in the second."""
    of_a, of_b = dict(_leaves(a, "")), dict(_leaves(b, ""))
    return [
        KeyDifference(path, _shown(of_a, path), _shown(of_b, path))
        for path in {**of_a, **of_b}
        if not _same(of_a, of_b, path)
    ]


def _leaves(value: object, path: str) -> Iterator[tuple[str, object]]:
    """Yield every value that is neither a table nor a list, with its path."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value:
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{path}[{number}]")
    else:
        yield path, value


def _same(a: Mapping[str, object], b: Mapping[str, object], path: str) -> bool:
    """True if both have the same value: 1 and 1.0 are the same setting, true and 1 are not."""
    if path not in a or path not in b:
        return False
    first, second = a[path], b[path]
    return first == second and isinstance(first, bool) == isinstance(second, bool)


def _shown(leaves: Mapping[str, object], path: str) -> str:
    if path not in leaves:
        return ABSENT
    text = ascii(leaves[path]) if isinstance(leaves[path], str) else str(leaves[path])
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}... ({len(text)} characters)"
