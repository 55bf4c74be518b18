"""Process that estimates, at the lowest priority: a request on stdin, a RigChange or a reason on stdout."""

from __future__ import annotations

import os
import pickle
import sys
from typing import Final

# Nice value of the lowest priority.
LOWEST: Final = 19


def main() -> None:
    """Answer one request. Both pipes belong to the daemon that started this process."""
    os.nice(LOWEST)
    from calib.errors import CalibError
    from omnid.refinement.estimate import estimate

    try:
        answer: object = estimate(pickle.load(sys.stdin.buffer))
    except CalibError as error:
        answer = str(error)
    pickle.dump(answer, sys.stdout.buffer)


if __name__ == "__main__":
    main()
