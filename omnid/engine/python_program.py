"""Commands and environments of the Python programs that omnid starts.

`python -m NAME` and `python -c TEXT` look for modules in the current folder first, where a `numpy.py` may lie that
another user wrote. Each program is therefore started with -P, which leaves that folder out (Python 3.11 and later).
"""

from __future__ import annotations

import os
import sys


def python(*words: str) -> list[str]:
    """Return the command that runs this interpreter with words such as "-m", "omnid", "report"."""
    return [sys.executable, "-P", *words]


def python_environment(**changes: str) -> dict[str, str]:
    """Return this program's environment with changes; the program finds the modules that this one finds.

    The entries of PYTHONPATH are absolute, because the program may run in another folder.
    """
    found = os.pathsep.join(entry for entry in sys.path if os.path.isabs(entry))
    return os.environ | {"PYTHONPATH": found} | changes
