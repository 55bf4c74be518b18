"""The option `--height-m` of commands that write a rig."""

from __future__ import annotations

import argparse
from typing import Final

from calib.rig import LEAST_HEIGHT_M, MAX_HEIGHT_M, Rig
from omnid.commands.options import option


def height(text: str) -> float:
    """Return the height [m] of an option."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not LEAST_HEIGHT_M <= value <= MAX_HEIGHT_M:
        raise argparse.ArgumentTypeError(f"expected {LEAST_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m, found {text}")
    return value


HEIGHT: Final = option(
    "--height-m",
    type=height,
    metavar="M",
    help="height of the lower viewpoint (the focus of the lower mirror) above the floor; without it `omnid calibrate "
    "height` finds it by the floor",
)


def with_height(rig: Rig, args: argparse.Namespace) -> Rig:
    """Return the rig with the height of the option, if it is given."""
    return rig if args.height_m is None else rig.at_height(args.height_m)


def height_of(rig: Rig) -> str:
    """Return the height that a rig states, in words."""
    height_m = rig.height_m()
    return (
        "no height of the cameras (--height-m, or `omnid calibrate height LOG`)"
        if height_m is None
        else f"cameras {height_m:.3f} m above the floor"
    )
