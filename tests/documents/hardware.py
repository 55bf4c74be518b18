"""Tables of docs/hardware.md: `python -m tests.documents.hardware` writes them, from the equations and the results."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from calib.panorama import fit_cylinder
from omnid.config import Config
from omnid.simulation.rendering.rigs import make_rig

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "docs" / "hardware.md"
BUDGET: Final = ROOT / "tests" / "benchmark" / "results" / "budget.json"
SIDES_PX: Final = (480, 720, 960, 1200)  # heights of common image formats
SIDE_PX: Final = 960  # of the table of baselines
BASELINES_M: Final = (0.1, 0.15, 0.2, 0.3, 0.4)
RANGES_M: Final = (1.0, 2.0, 4.0, 6.0)
FAR_SHARE: Final = 0.1  # of the range: up to here a point counts as located in the last column
FORMATS: Final = (
    ("640x480", "GREY", 640 * 480),
    ("1280x720", "GREY", 1280 * 720),
    ("1280x960", "GREY", 1280 * 960),
    ("1280x960", "YUYV", 2 * 1280 * 960),
    ("1920x1200", "GREY", 1920 * 1200),
)  # bytes of an image
RATES_HZ: Final = (10, 30)
# Isochronous transfers of one high-speed endpoint: three packets of 1024 bytes in each of 8000 microframes a second
# (USB 2.0, 5.6.3), less UVC's header of 12 bytes. A bus has room for little more than one such endpoint beside others.
ENDPOINT_MBPS: Final = (3 * 1024 - 12) * 8000 / 1e6
# Speed of one core against one of the machine that the budget was measured on: assumptions, nothing was measured.
ESTIMATED: Final = (("Raspberry Pi 5 (4 cores at 2.4 GHz)", 0.5), ("Jetson Orin Nano (6 cores at 1.5 GHz)", 0.35))


def tables() -> dict[str, str]:
    """Return the tables by their names."""
    return {"resolution": _resolution(), "baseline": _baseline(), "usb": _usb(), "computers": _computers()}


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    names = list(head)
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def focal_px(side_px: int) -> float:
    """Return the panorama's focal length f of the rendered rigs, whose horizon has 0.27 of the side as radius."""
    return fit_cylinder(make_rig(size=side_px)).focal_px


def _resolution() -> str:
    rows = []
    for side_px in SIDES_PX:
        f = focal_px(side_px)
        rows.append((str(side_px), f"{2 * math.pi * f:.0f}", f"{f:.0f}", f"{math.degrees(1 / f):.2f}"))
    return _table(("image height, px", "columns of the panorama", "f, px", "degrees a pixel"), rows)


def sigma_m(range_m: float, sigma_px: float, f_px: float, baseline_m: float) -> float:
    """Return the standard deviation of a range: r = f t / d, so sigma_r = r^2 sigma_d / (f t)."""
    return range_m**2 * sigma_px / (f_px * baseline_m)


def _baseline() -> str:
    config, f = Config(), focal_px(SIDE_PX)
    dense_px, tracked_px = config.stereo.noise_px, config.odometry.noise_px
    rows = []
    for t in BASELINES_M:
        cells = (f"{1e3 * sigma_m(r, dense_px, f, t):.0f} / {1e3 * sigma_m(r, tracked_px, f, t):.0f}" for r in RANGES_M)
        rows.append(
            (
                f"{100 * t:.0f}",
                f"{f * t / config.stereo.matching.disparities:.2f}",
                *cells,
                f"{FAR_SHARE * f * t / dense_px:.0f} / {FAR_SHARE * f * t / tracked_px:.0f}",
            )
        )
    at_ranges = (f"sigma at {r:.0f} m, mm" for r in RANGES_M)
    return _table(("t, cm", "least r, m", *at_ranges, "r with sigma = 10 %, m"), rows)


def _usb() -> str:
    rows = []
    for size, name, image_bytes in FORMATS:
        for rate_hz in RATES_HZ:
            mbps = image_bytes * rate_hz / 1e6
            fits = "no" if mbps > ENDPOINT_MBPS else "one camera a bus"
            fits = "two cameras on one bus" if 2 * mbps <= ENDPOINT_MBPS else fits
            rows.append((f"{size} {name}", str(rate_hz), f"{mbps:.1f}", fits))
    return _table(("image", "Hz", "MB/s of one camera", "USB 2.0"), rows)


def _computers() -> str:
    result = json.loads(BUDGET.read_text())
    times_ms = {name: float(time_ms) for name, time_ms, *_ in result["rows"]}
    usual_ms, small_ms = times_ms["30 Hz by the stamps"], times_ms["30 Hz by the stamps, profile small"]
    rows = [("2 cores of a shared x86-64 virtual machine", "measured", f"{usual_ms:.0f}", f"{small_ms:.0f}")]
    rows += [
        (name, f"estimate, a core at {speed:g} of that", f"{usual_ms / speed:.0f}", f"{small_ms / speed:.0f}")
        for name, speed in ESTIMATED
    ]
    return _table(("computer", "", "a pair, ms of processor", "with `--profile small`"), rows)


def page(text: str) -> str:
    """Return the page with its tables made again; they stand between comments with their names."""
    for name, table in tables().items():
        marks = re.compile(rf"(<!-- table {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        text, count = marks.subn(lambda match, table=table: f"{match[1]}{table}\n{match[2]}", text)
        assert count == 1, f"{PAGE.name} has no place for the table {name}"
    return text


def main() -> None:
    """Write the tables into the page."""
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
