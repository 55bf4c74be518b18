"""The tables of the report in Markdown, from the numbers measured on each log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

Values = dict[str, Any]
Seeds = dict[int, Values]  # measured values by seed
ABSENT = "-"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    names = list(head)
    lines = [names, ["---"] * len(names), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def spread(values: Iterable[float], form: Callable[[float], str]) -> str:
    """Return the median, with the smallest and the largest value in brackets; one value stands alone."""
    found = list(values)
    if not found:
        return ABSENT
    middle = form(float(np.median(found)))
    return middle if len(found) == 1 else f"{middle} ({form(min(found))} to {form(max(found))})"


def percent(digits: int = 2, sign: bool = False) -> Callable[[float], str]:
    """Return a formatter of ratios."""
    return lambda x: f"{100 * x:{'+' if sign else ''}.{digits}f} %"


def millimetres(digits: int = 1) -> Callable[[float], str]:
    """Return a formatter of metres."""
    return lambda x: f"{1e3 * x:.{digits}f} mm"


def number(digits: int = 0) -> Callable[[float], str]:
    """Return a formatter of numbers."""
    return lambda x: f"{x:.{digits}f}"


def _column(seeds: Seeds, method: str, key: str) -> list[float]:
    """Return a value of a method for every seed that has it."""
    return [values[method][key] for values in seeds.values() if key in values.get(method, {})]


def _methods(seeds: Seeds) -> list[str]:
    return list(next(iter(seeds.values())))


def wall_table(walls: dict[str, Seeds]) -> str:
    """Return the table of the walls: bricks, control, smooth texture."""
    rows = [
        [
            wall,
            method,
            spread(_column(seeds, method, "matches"), number()),
            spread(_column(seeds, method, "wrong"), percent(1)),
            spread(_column(seeds, method, "mismatched"), percent(1)),
            spread(_column(seeds, method, "completeness"), percent(1)),
            spread(_column(seeds, method, "coverage"), percent(1)),
            spread(_column(seeds, method, "rms_of_right_m"), millimetres()),
        ]
        for wall, seeds in walls.items()
        for method in _methods(seeds)
    ]
    return table(
        (
            "wall",
            "method",
            "matches a pair",
            "over 5 cm off",
            "over 20 cm off",
            "completeness",
            "coverage",
            "RMS of the right ones",
        ),
        rows,
    )


def turns_table(seeds: Seeds) -> str:
    """Return the table of right features, claimed features and time at each angle, medians of all seeds."""
    first_seed = next(iter(seeds.values()))["turns"]
    rows = []
    for row_number, first in enumerate(first_seed):
        at = [values["turns"][row_number] for values in seeds.values()]
        cells = [
            f"{_median(at, name, 'right')} / {_median(at, name, 'claimed')} / {_median(at, name, 'ms')} ms"
            for name in first["found"]
        ]
        rows.append([f"{angle(first['turn_deg'])}{', moved' if first['moved'] else ''}", *cells])
    return table(("turn", *(f"{name}: right / claimed / time" for name in first_seed[0]["found"])), rows)


def angle(turn_deg: float) -> str:
    """Return an angle with its sign; a turn to the left is positive."""
    return f"{turn_deg:+g}°" if turn_deg else "0°"


def _median(rows: list[Values], name: str, key: str) -> str:
    return f"{np.median([row['found'][name][key] for row in rows]):.0f}"


def turns_summary(seeds: Seeds) -> str:
    """Return the gain of each search at 18 degrees both ways, and its worst angle, for each seed."""
    rows = []
    for seed, values in seeds.items():
        found = {row["turn_deg"]: row["found"] for row in values["turns"] if not row["moved"]}
        for name in [n for n in found[9] if n != "plain KLT"]:
            right = {turn_deg: counts[name]["right"] for turn_deg, counts in found.items()}
            worst = min(right, key=right.__getitem__)
            gains = [f"{right[a] / max(1, found[a]['plain KLT']['right']):.1f} times plain KLT" for a in (18, -18)]
            rows.append([str(seed), name, *gains, f"{right[worst]} of {right[0]} (at {angle(worst)})"])
    return table(("seed", "search", "right at +18°", "right at -18°", "fewest right, of those at 0°"), rows)


def paths_table(seeds: Seeds) -> str:
    """Return the table of the path between two walls, each step from the paper to omnid."""
    rows = [
        [
            method,
            spread(_column(seeds, method, "length_error"), percent(3, sign=True)),
            spread(_column(seeds, method, "ate_m"), millimetres(2)),
            spread(_column(seeds, method, "end_m"), millimetres(2)),
            spread(_column(seeds, method, "heading_deg"), lambda x: f"{x:.3f}°"),
        ]
        for method in _methods(seeds)
    ]
    return table(("method", "length", "ATE rmse", "end", "heading, max"), rows)


def building_table(runs: dict[str, Values]) -> str:
    """Return the table of the round through the building, by run and method."""
    rows = [[run, method, *_building_row(v)] for run, values in runs.items() for method, v in values.items()]
    return table(
        (
            "seed, renderer",
            "method",
            "path",
            "length",
            "ATE rmse",
            "end to start",
            "heading, max",
            "map RMS",
            "map median",
            "map over 5 cm off",
            "walls mapped",
        ),
        rows,
    )


def _building_row(v: Values) -> list[str]:
    length_m = v["true_length_m"]
    path = [
        f"{length_m:.2f} m",
        percent(3, True)(v["length_error"]),
        f"{1e3 * v['ate_m']:.1f} mm = {v['ate_m'] / length_m:.3%}",
        f"{1e3 * v['end_to_start_m']:.1f} mm = {v['end_to_start_m'] / length_m:.3%}",
        f"{v['heading_deg']:.3f}°",
    ]
    if (m := v.get("map")) is None:
        return [*path, *4 * [ABSENT]]
    return [
        *path,
        millimetres()(m["rms_m"]),
        millimetres()(m["median_m"]),
        percent()(m["off_by_0.05_m"]),
        percent(1)(m["completeness"]),
    ]


def speed_table(seeds: Seeds) -> str:
    """Return the table of processor times."""
    rows = [[task, spread([values[task] for values in seeds.values()], number())] for task in _methods(seeds)]
    return table(("task", "processor time of a pair, ms"), rows)
