"""Large arrays that are done with, to memory that the machine has back: mallopt(3).

The C library keeps what was once freed, for more of the same: after an hour of passes more than twice what
is in use.
"""

from __future__ import annotations

import contextlib
import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
_LARGE_BYTES = 4 * 2**20  # what is smaller comes and goes too often to be asked of the kernel each time


def give_back() -> None:
    """Have what is large given back once it is free; other C libraries than glibc do as they do."""
    with contextlib.suppress(AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_ARENA_MAX, 1)  # what one thread is done with, another has; they seldom ask at once
