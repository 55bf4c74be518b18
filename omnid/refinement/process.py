"""Process that estimates, at a low priority: a request on stdin, a RigChange or a reason on stdout."""

from __future__ import annotations

import os
import pickle
import sys
from typing import Final

# Low priority: beside a program at the usual one it gets a tenth of a core. At 19, the lowest, four busy
# programs on two cores left it less than a second in 97: an estimate of some seconds could not end in its five minutes.
NICE: Final = 10


def main() -> None:
    """Answer one request. Both pipes belong to the daemon that started this process."""
    os.nice(NICE)
    from calib.errors import CalibError
    from omnid.refinement.estimate import estimate

    try:
        answer: object = estimate(pickle.load(sys.stdin.buffer))
    except CalibError as error:
        answer = str(error)
    pickle.dump(answer, sys.stdout.buffer)


if __name__ == "__main__":
    main()
