"""The report's Markdown, from the numbers measured on each log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

Values = dict[str, Any]
Seeds = dict[int, Values]  # what was measured, by seed


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    names = list(head)
    lines = [names, ["---"] * len(names), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def spread(values: Iterable[float], form: Callable[[float], str]) -> str:
    """Median, and in brackets the smallest and the largest; one value stands alone."""
    found = list(values)
    middle = form(float(np.median(found)))
    return middle if len(found) == 1 else f"{middle} ({form(min(found))} to {form(max(found))})"


def percent(digits: int = 2, sign: bool = False) -> Callable[[float], str]:
    """Formats a ratio."""
    return lambda x: f"{100 * x:{'+' if sign else ''}.{digits}f} %"


def millimetres(digits: int = 1) -> Callable[[float], str]:
    """Formats metres."""
    return lambda x: f"{1e3 * x:.{digits}f} mm"


def number(digits: int = 0) -> Callable[[float], str]:
    """Formats a number."""
    return lambda x: f"{x:.{digits}f}"


def _column(seeds: Seeds, method: str, key: str) -> list[float]:
    return [values[method][key] for values in seeds.values()]


def _methods(seeds: Seeds) -> list[str]:
    return list(next(iter(seeds.values())))


def wall_table(walls: dict[str, Seeds]) -> str:
    """Brick wall and control."""
    rows = [[wall, method, spread(_column(seeds, method, "wrong"), percent()),
             spread(_column(seeds, method, "completeness"), percent(1)),
             spread(_column(seeds, method, "rms_m"), millimetres()),
             spread(_column(seeds, method, "rms_of_right_m"), millimetres())]
            for wall, seeds in walls.items() for method in _methods(seeds)]
    return table(("wall", "method", "over 5 cm off", "completeness", "RMS to the plane", "RMS of the right ones"), rows)


def turns_table(seeds: Seeds) -> str:
    """Features tracked rightly, and time, at each angle."""
    rows = []
    for number_of_row, first in enumerate(next(iter(seeds.values()))["turns"]):
        at = [values["turns"][number_of_row] for values in seeds.values()]
        cells = [f"{_median(at, name, 'right')} / {_median(at, name, 'claimed')} / {_median(at, name, 'ms')} ms"
                 for name in first["found"]]
        rows.append([f"{first['turn_deg']:g}°{', moved' if first['moved'] else ''}", *cells])
    names = next(iter(seeds.values()))["turns"][0]["found"]
    return table(("turn", *(f"{name}: right / claimed / time" for name in names)), rows)


def _median(rows: list[Values], name: str, key: str) -> str:
    return f"{np.median([row['found'][name][key] for row in rows]):.0f}"


def turns_verdict(seeds: Seeds) -> str:
    """What the issue of large turns comes to, for each seed: at 18 degrees, and the worst angle against 9 degrees."""
    rows = []
    for seed, values in seeds.items():
        pure = {row["turn_deg"]: row["found"] for row in values["turns"] if not row["moved"]}
        for name in [n for n in pure[9] if n != "plain KLT"]:
            right = {angle: found[name]["right"] for angle, found in pure.items()}
            worst = min(right, key=right.__getitem__)
            gain = right[18] / max(1, pure[18]["plain KLT"]["right"])
            least = f"{right[worst] / right[9]:.0%} (at {worst:g}°)"
            rows.append([str(seed), name, f"{gain:.1f} times plain KLT", least])
    return table(("seed", "search", "right at 18°", "fewest right, of those at 9°"), rows)


def paths_table(seeds: Seeds) -> str:
    """Two walls, each step from the paper to omnid."""
    rows = [[method, spread(_column(seeds, method, "length_error"), percent(3, sign=True)),
             spread(_column(seeds, method, "ate_m"), millimetres(2)),
             spread(_column(seeds, method, "end_m"), millimetres(2)),
             spread(_column(seeds, method, "heading_deg"), lambda x: f"{x:.3f}°")] for method in _methods(seeds)]
    return table(("method", "length", "ATE rmse", "end", "heading, max"), rows)


def building_table(seeds: Seeds) -> str:
    """Once around the building."""
    rows = []
    for values in seeds.values():
        for method, v in values.items():
            m, length = v["map"], v["true_length_m"]
            rows.append([method, f"{length:.2f} m", percent(3, True)(v["length_error"]),
                         f"{1e3 * v['ate_m']:.1f} mm = {v['ate_m'] / length:.3%}",
                         f"{1e3 * v['end_to_start_m']:.1f} mm = {v['end_to_start_m'] / length:.3%}",
                         f"{v['heading_deg']:.3f}°", millimetres()(m["rms_m"]), millimetres()(m["median_m"]),
                         percent()(m["off_by_0.05_m"]), percent(1)(m["completeness"])])
    return table(("method", "path", "length", "ATE rmse", "end to start", "heading, max", "map RMS", "map median",
                  "map over 5 cm off", "walls mapped"), rows)


def speed_table(seeds: Seeds) -> str:
    """Milliseconds a pair."""
    rows = [[task, spread([values[task] for values in seeds.values()], number())] for task in _methods(seeds)]
    return table(("task, one thread", "ms a pair"), rows)
