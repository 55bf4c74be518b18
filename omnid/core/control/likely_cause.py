"""What makes two accounts of one drive differ as they do: a factor, a sign, sides that are exchanged.

The accounts are motions of the base in the same steps: distances d [m] and turns t [rad] as the images show them, and
D, T as wheels or gyro report them. Each cause is a linear relation:

    scale       D = k d, T = k t          wheel radius, gear; a gyro in degrees: k = 57.3
    track       D = d,   T = k t
    exchanged   D = d,   T = -t           left and right
    reversed    D = -d,  T = -t
    one side    D = b t, T = d / b        the left wheel turns the other way, b is half a track; b < 0: the right one
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

LEAST_M, LEAST_RAD = 0.01, 0.02  # root of the sum of squares that shows a relation: ten times the noise of 100 steps
ALIKE: Final = 0.8  # correlation of accounts that are proportional, up to a delay and slip
SAME: Final = 0.2  # share by which a factor may differ from one that explains it
DEG_PER_RAD: Final = math.degrees(1.0)
SIZE: Final = "motor.drive.wheel_radius_m, gear"


class Steps(NamedTuple):
    """Distances [m] and turns [rad] of the base in consecutive steps; NaN where one is not known."""

    distances: Sequence[float]
    turns: Sequence[float]


def of_gyro(seen: Sequence[float], gyro: Sequence[float]) -> str:
    """Return why the turns of a gyro differ from those seen; empty where no relation explains it."""
    factor = _factor(gyro, seen, LEAST_RAD)
    if factor is None or _is(factor, 1.0):
        return ""
    if factor < 0:
        return f"the gyro turns the other way{_times(-factor)}: sign, or mirrored images"
    guess = {DEG_PER_RAD: ": deg/s?", 1 / DEG_PER_RAD: ": is it in rad/s and divided by 57?"}
    unit = next((words for unit, words in guess.items() if _is(factor, unit)), "")
    return f"the gyro turns {factor:.2g} times as far as the images{unit}"


def of_wheels(seen: Steps, wheels: Steps) -> str:
    """Return why the motion that wheels report differs from that seen; empty where no relation explains it."""
    way, turn = _factor(wheels.distances, seen.distances, LEAST_M), _factor(wheels.turns, seen.turns, LEAST_RAD)
    # 1. One side: what is a turn of one account is a way of the other. On an arc a scale k has k k for their product.
    aside, ahead = _factor(wheels.distances, seen.turns, LEAST_RAD), _factor(wheels.turns, seen.distances, LEAST_M)
    crossed = [factor for factor in (aside, ahead) if factor is not None]
    both = way is not None and turn is not None and _is(way, -1.0) and _is(turn, -1.0)
    of_both = len(crossed) == 2 and _is(crossed[0] * crossed[1], 1.0) and not both
    if of_both or (len(crossed) == 1 and way is None and turn is None):
        side = "left" if crossed[0] > 0 else "right"
        return f"the {side} wheel turns the other way: motor.drive.reverse_{side}, or its encoder"
    # 2. Signs and factors of both.
    if way is not None and way < 0 and (turn is None or turn < 0):
        return f"the wheels drive the other way{_times(-way)}: motor.drive.reverse_left and reverse_right"
    if turn is not None and turn < 0:
        more = "" if way is None or way > 0 else ", reverse_left and reverse_right"
        return f"the wheels turn the other way: motor.drive.swapped{more}, or mirrored images"
    if way is not None and not _is(way, 1.0):
        return f"the wheels drive {way:.2g} times as far as the images: {SIZE}, or the baseline of the rig"
    if turn is not None and not _is(turn, 1.0):
        return f"the wheels turn {turn:.2g} times as far as the images: motor.drive.track_m"
    return ""


def of_images(seen: Sequence[float], gyro: Sequence[float]) -> str:
    """Return why images differ from wheels and a gyro that agree; empty where their turns do not tell."""
    factor = _factor(gyro, seen, LEAST_RAD)
    return "the images turn the other way: are they mirrored?" if factor is not None and factor < 0 else ""


def _factor(found: Sequence[float], seen: Sequence[float], least: float) -> float | None:
    """Return k in found = k seen by least squares; None where they are not proportional, or seen hardly moves."""
    pairs = [(x, y) for x, y in zip(found, seen, strict=True) if math.isfinite(x) and math.isfinite(y)]
    squares_x, squares_y = sum(x * x for x, _ in pairs), sum(y * y for _, y in pairs)
    product = sum(x * y for x, y in pairs)
    if math.sqrt(squares_y) < least or abs(product) < ALIKE * math.sqrt(squares_x * squares_y):
        return None
    return product / squares_y if product else None


def _is(factor: float, expected: float) -> bool:
    return abs(factor / expected - 1.0) <= SAME


def _times(factor: float) -> str:
    return "" if _is(factor, 1.0) else f", {factor:.2g} times as far"
