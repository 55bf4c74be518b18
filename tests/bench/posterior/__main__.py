"""Floor, surfaces and edges against the truth: `python -m tests.bench.posterior CASE ... --seeds 1 3`.

A base drives straight into a small room at its true poses (no odometry, no wheels), a pair each 5 cm. Directions of one
degree whose nearest obstacle or edge lies within 0.2 to 4 m count as found (the ring has it, or something before it),
unknown, or missed: the way is said to be free beyond it and a tolerance. A false obstacle lies before the nearest true
one. What is missed of the thing itself is given for ranges below 0.8, to 1.25, to 2 m, beyond, and for all of them.
Free ahead: what is said of the fan of 28 degrees ahead in the last rings, against the truth. The table of evidence
(--reliability) has the share of cells that are free, by what the grid says of them.
"""

from __future__ import annotations

import argparse

import numpy as np

from omnid.engine.kernel_cache import prepare_kernels
from tests.bench.posterior.drives import ODDS_BINS, OPEN_M, Scores, drive, usual_robot
from tests.bench.posterior.scenes import CASES


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=sorted(CASES), metavar="CASE")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 1), metavar=("FIRST", "LAST"))
    parser.add_argument("--size", type=int, default=512, help="of the images, px")
    parser.add_argument("--steps", type=int, default=40, help="of 5 cm")
    parser.add_argument("--reliability", action="store_true", help="print the table of evidence too")
    arguments = parser.parse_args()
    prepare_kernels()
    robot = usual_robot(arguments.size)
    print(
        "| case | found | missed | false | thing found | thing missed, % | told free to "
        f"{' / '.join(f'{m:g}' for m in OPEN_M)} m | most free beyond, ahead | ms a pair |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    total = np.zeros((len(ODDS_BINS) - 1, 2))
    for case in arguments.cases:
        scores = Scores()
        for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
            drive(case, seed, robot, arguments.steps, scores)
        total += scores.cells
        print(scores.row(case), flush=True)
    if arguments.reliability:
        print("| log-odds of the floor | cells | free | said |\n|---|---|---|---|")
        for low, high, (free, count) in zip(ODDS_BINS[:-1], ODDS_BINS[1:], total, strict=True):
            claimed = [100 / (1 + np.exp(-odds)) for odds in (low, high)]
            print(
                f"| {low:g} to {high:g} | {count:.0f} | {100 * free / max(count, 1):.1f} % | "
                f"{claimed[0]:.0f} to {claimed[1]:.0f} % |"
            )


if __name__ == "__main__":
    main()
