"""A thread's work, to work that goes before all else on the machine: sched(7).

A chunk is stamped once its reader runs. Where every processor is busy that takes as long as the kernel lets
another thread go on, some 3 ms on Linux since 6.6, unless the reader is of a real-time policy.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import ParamSpec

_P = ParamSpec("_P")


def urgently(work: Callable[_P, None], *args: _P.args, **kwargs: _P.kwargs) -> None:
    """Do it ahead of every thread that is not urgent, where this process may (RLIMIT_RTPRIO); else as any.

    The calling thread stays so; what it starts does not.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    work(*args, **kwargs)
