"""Sensitivity of results to the constants that decide: `python -m tests.benchmark.sensitivity FOLDER ...`.

Each constant of CONSTANTS is multiplied by 0.67 and by 1.5, in a process of its own, on rendered logs of seeds that
are not those of development (tests/benchmark/seeds.toml), in folders NAME_SIZEpx_sSEED: two_laps for the constants of
places, two_walls for those of the rig checks, all but two_laps for those of odometry. Outcomes are kept in --kept, so
that a series that was ended goes on where it was; --minutes ends it.

    python -m tests.simulation two_walls --seed 601 --size 384 --pairs 24 --out DIR/two_walls_384px_s601

ATE ratio: geometric mean over the logs of one size of the ATE with the changed constant by that with its own value.
Constants of `*_kernels.py` are not in the list: they are compiled code, which would have to be made for each factor.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.benchmark.constants import ROOT, Constant, constants
from tests.benchmark.results import Column, ResultTable
from tests.benchmark.seeds import DEVELOPMENT, family_and_seed, role_of

FACTORS: Final = (0.67, 1.5)
SIZES_PX: Final = (384, 768, 1152)
TIMEOUT_S: Final = 1800.0
# Room or file below omnid/core: the names of its constants.
CONSTANTS: Final = {
    "odometry/limits": (
        "features",
        "refresh",
        "keyframes",
        "min_inliers",
        "min_inlier_ratio",
        "good_inliers",
        "good_inlier_ratio",
    ),
    "odometry/odometry": ("TEXTURED_CORNERS",),
    "odometry/pose_search": ("NEAR_RATIO", "GOOD_TRACKED_RATIO", "TRACKED_SHARE"),
    "odometry/pose_estimation": ("RANSAC_THRESHOLD_PX",),
    "odometry/frame_to_map": (
        "OUTLIER_SQUARED",
        "FEW_RATIO",
        "LIKELY_RATIO",
        "ENOUGH_RATIO",
        "COARSE_SIGMA_PX",
        "CORRELATED_LANDMARKS",
    ),
    "odometry/corners": ("CELL_PX", "MIN_RESPONSE", "NOISE_RESPONSE", "CROSS_PX", "APART_PX"),
    "odometry/static_mask": ("MIN_FLOW_RAD", "SAME_LEVEL", "MIN_CONTRAST", "EVIDENCE"),
    "odometry/plane_patches": ("SAME_SURFACE_PX", "SLOPE_PRIOR", "MIN_NOISE_GREY", "SLOPE_REACH_PX"),
    "odometry/local_map": ("REACH_PX", "COARSE_ITERATIONS"),
    "odometry/motion_filter": ("JERK_PSD", "START_VELOCITY_VARIANCE"),
    "odometry/motion_model": ("SLOWING_S", "SUDDEN_RAD"),
    "odometry/keyframes": ("LANDMARK_SPACING_PX",),
    "odometry/patch_alignment": ("CROSS_PX",),
    "odometry/new_landmarks": ("SLOPE_STEP_PX",),
    "places/place_search": ("NEAR_M",),
    "places/place_comparison": ("NEAR_INLIERS", "FAR_INLIERS", "RUNNER_UP"),
    "places/recognition": ("SIGMA_PX", "THRESHOLD_PX", "CORRELATED", "YAW_WINDOW_RAD"),
    "places/hypotheses": ("SAME_M", "CONSISTENT"),
    "places/localisation": ("GATE_M",),
    "places/features": ("FEATURES",),
    "places/correction": ("ACCEPTED",),
    "rig": ("DRIFTED_DEG", "BROKEN_DEG", "SIGMAS", "MIN_MATCHES", "MIN_MATCHED_PART", "MIN_CORRELATION", "DRIFTED_PX"),
}
Outcome = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Trial:
    """A constant and its factor on the logs of one size; factor 1: as it is."""

    kind: str  # odometry, places or rig
    constant: Constant | None  # None: factor 1
    factor: float
    folders: tuple[str, ...]

    @property
    def key(self) -> str:
        """The name by which the outcome is kept."""
        name = f"{self.constant.path} {self.constant.name}" if self.constant is not None else self.kind
        return f"{name} {self.factor:g} {' '.join(Path(folder).name for folder in self.folders)}"


def chosen(names_by_file: Mapping[str, Sequence[str]] = CONSTANTS) -> list[Constant]:
    """Return the constants of a list; raises ValueError for one that is not there, or not once."""
    everything, found = constants(), []
    for room, names in names_by_file.items():
        for name in names:
            same = [
                one for one in everything if one.name == name and re.match(rf"omnid/core/{room}(/|\.py$)", one.path)
            ]
            if len(same) != 1:
                raise ValueError(f"omnid/core/{room}: one {name} was expected, {len(same)} found")
            found += same
    return found


def logs_of(kind: str, folders: Sequence[str], size_px: int) -> tuple[str, ...]:
    """Return the folders that a kind of constant is tried on."""
    families = {"places": ("two_laps",), "rig": ("two_walls",)}.get(kind)
    sized = [folder for folder in folders if f"_{size_px}px_" in Path(folder).name]
    return tuple(
        folder
        for folder in sized
        if (Path(folder).name.startswith(families) if families else "two_laps" not in Path(folder).name)
    )


def kind_of(constant: Constant) -> str:
    """Return the room of a constant."""
    return Path(constant.path).parts[2]


def trials(folders: Sequence[str], sizes_px: Sequence[int]) -> Iterator[Trial]:
    """Yield all trials, those of the smallest images first."""
    for size_px in sizes_px:
        for kind in ("odometry", "rig", "places"):
            if logs := logs_of(kind, folders, size_px):
                yield Trial(kind, None, 1.0, logs)
                for constant in (one for one in chosen() if kind_of(one) == kind):
                    yield from (Trial(kind, constant, factor, logs) for factor in FACTORS)


def measured(trial: Trial) -> Outcome:
    """Run a trial in a process of its own."""
    path, name = (trial.constant.path, trial.constant.name) if trial.constant is not None else ("none.py", "NONE")
    words = [sys.executable, "-P", "-m", "tests.benchmark.scaled_constant", trial.kind, f"{trial.factor:g}", path, name]
    done = subprocess.run([*words, *trial.folders], cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    if done.returncode:
        return {"values": [], "found": {folder: {"error": done.stderr.strip()[-200:]} for folder in trial.folders}}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def words_of(trial: Trial, own: Outcome, changed: Outcome) -> tuple[float | None, str]:
    """Return the ratio of the errors, and what else differs, of one trial from the run with the own value."""
    ratios, remarks = [], []
    for folder in trial.folders:
        before, after = own["found"][folder], changed["found"][folder]
        name = "_".join(Path(folder).name.split("_")[:-2])
        if "error" in after:
            remarks.append(f"{name}: {after['error'][:60]}")
        elif "ate_mm" in after:
            ratios.append(after["ate_mm"] / before["ate_mm"])
            if after.get("not_tracking", 0) > before.get("not_tracking", 0) + 0.005:
                remarks.append(f"{name}: {100 * after['not_tracking']:.0f} % not tracking")
            remarks += [
                f"{key} {before[key]} to {after[key]}"
                for key in ("loops", "false")
                if key in after and after[key] != before[key]
            ]
        else:
            remarks += [
                f"rig {turned} off: {before[turned]} to {outcome}"
                for turned, outcome in after.items()
                if outcome != before[turned]
            ]
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios)) if ratios else None
    return mean, "; ".join(remarks)


def rounded(value: str) -> str:
    """Return the text of a value, a number with four digits."""
    try:
        return f"{float(value):.4g}"
    except ValueError:
        return value


def table(folders: Sequence[str], kept: dict[str, Outcome]) -> ResultTable:
    """Return the rows of all constants that were tried at one size at least."""
    columns = (
        Column("constant"),
        Column("file"),
        Column("value"),
        Column("tried"),
        *(Column(f"ATE ratio at {size_px} px", "", 2) for size_px in SIZES_PX),
        Column("what else changed"),
    )
    result = ResultTable(
        "sensitivity", "accuracy", "Sensitivity to constants, times 0.67 and 1.5", columns, REMARKS, quiet=True
    )
    for constant in chosen():
        for factor in FACTORS:
            ratios, remarks, tried = list[float | None](), dict[str, None](), ""
            for size_px in SIZES_PX:
                kind = kind_of(constant)
                trial = Trial(kind, constant, factor, logs_of(kind, folders, size_px))
                own = kept.get(Trial(kind, None, 1.0, trial.folders).key)
                changed = kept.get(trial.key)
                ratio, words = words_of(trial, own, changed) if own and changed else (None, "")
                ratios.append(ratio)
                if changed:
                    tried = rounded(changed["values"][1]) if changed["values"] else ""
                if words:
                    remarks[f"{size_px} px: {words}"] = None
            if tried:
                file = constant.path.removeprefix("omnid/core/")
                result.add(constant.name, file, constant.value, tried, *ratios, "; ".join(remarks))
    have = {(row[0], row[1]) for row in result.rows}
    left = [one.name for one in chosen() if (one.name, one.path.removeprefix("omnid/core/")) not in have]
    result.remarks = (*REMARKS, *([f"Not run: {', '.join(left)}."] if left else []))
    result.seeds = [seed for folder in folders if (seed := family_and_seed(Path(folder).name))]
    return result


REMARKS: Final = (
    "Short logs (10 to 24 pairs for odometry and rig, 128 for places). A ratio above 2 is a defect. A ratio of exactly "
    "1 with nothing else changed shows that the constant decided nothing on these logs, not that it is safe elsewhere.",
    "Empty: not run at that size, as are factors without a row. Constants of compiled files (*_kernels.py) are not in "
    "the list.",
)


def main() -> None:
    """Run what is not kept yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="FOLDER")
    parser.add_argument("--kept", type=Path, default=ROOT / "build" / "sensitivity.json")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no trial is begun")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES_PX)
    args = parser.parse_args()
    for folder in args.folders:
        seed = family_and_seed(Path(folder).name)
        if seed is None or role_of(*seed) == DEVELOPMENT:
            parser.error(f"{folder}: a folder NAME_SIZEpx_sSEED of a seed that is not one of development was expected")
    kept: dict[str, Outcome] = json.loads(args.kept.read_text()) if args.kept.exists() else {}
    end_s = time.monotonic() + 60 * args.minutes
    for trial in trials(args.folders, args.sizes):
        if trial.key not in kept and time.monotonic() < end_s:
            kept[trial.key] = measured(trial)
            args.kept.parent.mkdir(parents=True, exist_ok=True)
            args.kept.write_text(json.dumps(kept, indent=1))
            print(trial.key.rpartition("/")[2], json.dumps(list(kept[trial.key]["found"].values())), flush=True)
    print(table(args.folders, kept).save())


if __name__ == "__main__":
    main()
