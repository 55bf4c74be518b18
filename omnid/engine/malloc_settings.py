"""Where the threads of the daemon get their memory; imports nothing that starts a thread."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Final

_M_ARENA_MAX: Final = -8  # malloc.h of glibc


def share_heap() -> None:
    """Has all threads that start from now on allocate from one heap; to be called before numpy starts its own.

    glibc gives each thread one of its own otherwise, of which locked pages never go back to the kernel: every thread
    keeps the most that it ever needed. The one heap shrinks, locked or not.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
