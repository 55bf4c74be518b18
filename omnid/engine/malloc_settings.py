"""Settings of the C library's memory allocator; imports nothing that starts a thread."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Final

_M_ARENA_MAX: Final = -8  # malloc.h of glibc


def use_one_malloc_arena() -> None:
    """Let all threads share one malloc arena; to be called before numpy starts its threads.

    Otherwise glibc gives each thread its own arena, whose locked pages never return to the kernel, so every thread
    keeps the most memory it ever needed. The main arena shrinks, locked or not.
    """
    with suppress(AttributeError):  # not glibc
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
